"""Small dense linear algebra of the kernels: loops over rows that are contiguous, which the compiler vectorises.

Sums may be reordered; nothing else about floating point is relaxed, so that NaN and infinities behave as they should.
"""

from __future__ import annotations

from ._frame import lean

reordered = {"reassoc", "contract"}
"""What the compiler may do to a sum: add in another order, fuse a product with its sum."""


@lean(fastmath=reordered)
def dot(a, b, start, stop):
    """Return sum_i a_i b_i over start <= i < stop."""
    total = 0.0
    for i in range(start, stop):
        total += a[i] * b[i]
    return total


@lean(fastmath=reordered)
def add_multiple(y, factor, x, n):
    """Add factor x to y, over the first n."""
    for i in range(n):
        y[i] += factor * x[i]


@lean
def fill(a, value):
    """Set all of a to the value."""
    for i in range(len(a)):
        a[i] = value


@lean
def any_number(a):
    """Return whether one of them is not 0."""
    found = False
    for x in a:
        found = found or x != 0.0
    return found
