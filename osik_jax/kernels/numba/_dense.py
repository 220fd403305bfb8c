"""Small dense linear algebra of the kernels: loops over rows that are contiguous, which the compiler vectorises.

Sums may be reordered; nothing else about floating point is relaxed, so that NaN and infinities behave as they should.
"""

from __future__ import annotations

import numpy as np

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


@lean(fastmath=reordered)
def four_dots(a, b, c, d, n):
    """Return a'c, a'd, b'c and b'd over the first n: each number is read once for two products."""
    ac, ad, bc, bd = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        ac += a[i] * c[i]
        ad += a[i] * d[i]
        bc += b[i] * c[i]
        bd += b[i] * d[i]
    return ac, ad, bc, bd


@lean
def gram(B, S, k, n):
    """Write B B' of the first k rows and n columns of B to S, on and below the diagonal; S above it is used up."""
    even = k - k % 2
    for a in range(0, even, 2):
        for b in range(0, a + 1, 2):
            S[a, b], S[a, b + 1], S[a + 1, b], S[a + 1, b + 1] = four_dots(B[a], B[a + 1], B[b], B[b + 1], n)
    for b in range(k if even < k else 0):
        S[even, b] = dot(B[even], B[b], 0, n)


@lean
def cholesky(S, n, smallest):
    """Write L with L L' = S into S; return whether every pivot L_jj^2 is at least ``smallest`` of its S_jj.

    Column by column: the sums of a column need none of its own numbers, so that none waits for the one before.
    """
    for j in range(n):
        pivot = S[j, j] - dot(S[j], S[j], 0, j)
        if not (pivot > 0.0 and pivot >= smallest * S[j, j]):
            return False
        S[j, j] = np.sqrt(pivot)
        inverse = 1.0 / S[j, j]
        for i in range(j + 1, n):
            S[i, j] = (S[i, j] - dot(S[i], S[j], 0, j)) * inverse
    return True


@lean
def forward(L, b, n):
    """Overwrite b with L^-1 b."""
    for i in range(n):
        b[i] = (b[i] - dot(L[i], b, 0, i)) / L[i, i]


@lean
def backward(L, b, n):
    """Overwrite b with L'^-1 b."""
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        add_multiple(b, -b[i], L[i], i)


@lean
def rotate(a, b, cosine, sine, start, n):
    """Rotate a and b by Givens, from ``start`` to n: to cosine a + sine b and cosine b - sine a."""
    for i in range(start, n):
        first = a[i]
        a[i] = cosine * first + sine * b[i]
        b[i] = cosine * b[i] - sine * first
