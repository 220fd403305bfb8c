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
    """sum_i a_i b_i over start <= i < stop."""
    total = 0.0
    for i in range(start, stop):
        total += a[i] * b[i]
    return total


@lean(fastmath=reordered)
def add_multiple(y, factor, x, n):
    """y += factor x, over the first n."""
    for i in range(n):
        y[i] += factor * x[i]


@lean
def fill(a, value):
    """a = value, everywhere."""
    for i in range(len(a)):
        a[i] = value


@lean
def any_number(a):
    """Whether one of them is not 0."""
    found = False
    for x in a:
        found = found or x != 0.0
    return found


@lean
def cholesky(S, n, smallest):
    """L with L L' = S in the lower triangle of S; whether every pivot L_ii^2 is at least ``smallest`` of its S_ii."""
    for i in range(n):
        least = smallest * S[i, i]
        for j in range(i):
            S[i, j] = (S[i, j] - dot(S[i], S[j], 0, j)) / S[j, j]
        pivot = S[i, i] - dot(S[i], S[i], 0, i)
        if not (pivot > 0.0 and pivot >= least):
            return False
        S[i, i] = np.sqrt(pivot)
    return True


@lean
def forward(L, b, n):
    """b becomes L^-1 b."""
    for i in range(n):
        b[i] = (b[i] - dot(L[i], b, 0, i)) / L[i, i]


@lean
def backward(L, b, n):
    """b becomes L'^-1 b."""
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        add_multiple(b, -b[i], L[i], i)


@lean
def rotate(a, b, cosine, sine, start, n):
    """(a, b) become (cosine a + sine b, cosine b - sine a), from ``start`` to n: a Givens rotation."""
    for i in range(start, n):
        first = a[i]
        a[i] = cosine * first + sine * b[i]
        b[i] = cosine * b[i] - sine * first


@lean
def add_row(R, v, n):
    """R becomes upper triangular R+ with R+'R+ = R'R + v v', by Givens rotations; v is used up."""
    for k in range(n):
        if v[k] != 0.0:
            length = np.hypot(R[k, k], v[k])
            rotate(R[k], v, R[k, k] / length, v[k] / length, k, n)


@lean
def invert_upper(R, columns, n):
    """Row k of ``columns`` becomes column k of R^-1."""
    for k in range(n):
        column = columns[k]
        column[k] = 1.0 / R[k, k]
        for i in range(k - 1, -1, -1):
            column[i] = -dot(R[i], column, i + 1, k + 1) / R[i, i]
