"""Factors of one level of a hierarchy within an orthonormal basis (``_level_workspace.py`` has its columns' meaning).

A Householder reflection from the right turns columns of the basis among each other, so that a row gets all its length
into one column. The active hard rows are triangular in their columns, and the level's rows are factored by pivoted QR
in the free ones.
"""

from __future__ import annotations

from math import sqrt

from numba import int64

from ...numerics._constants import FACTOR_RIDGE
from . import _level_workspace as ws
from ._frame import lean
from ._level_workspace import clear
from ._vectors import add, add_squares, dot


@lean
def reflection(row, at, n, v):
    """Return the scale of ``I - scale v v'``, which takes a row's columns from ``at`` on into that one; v is written.

    v is ``row + sign(row_at) |row| e_at``: the sign without cancellation.
    """
    norm = sqrt(dot(row, row, at, n))
    for j in range(at, n):
        v[j] = row[j]
    head = row[at]
    v[at] = head + (-norm if head < 0.0 else norm)
    return 1.0 / (norm * (norm + abs(head)))


@lean
def reflect(rows, first_row, stop_row, v, scale, at, n):
    """Multiply some rows by ``I - scale v v'`` from the right."""
    for q in range(first_row, stop_row):
        row = rows[q]
        by = scale * dot(row, v, at, n)
        if by != 0.0:
            add(row, -by, v, at, n)


@lean
def from_basis(F, J, s, start, stop, out):
    """Compute ``out = Z coordinates`` over some columns; the coordinates are in WORK."""
    Z = F[s.Z : s.Z + s.h]
    for i in range(s.n):
        out[i] = dot(Z[i], F[ws.WORK], start, stop)


@lean
def to_basis(F, J, s, start, a, out):
    """Compute ``out = Z' a`` in the columns from ``start`` on."""
    Z = F[s.Z : s.Z + s.h]
    n = s.n
    clear(out, start, s.n)
    for i in range(n):
        if a[i] != 0.0:
            add(out, a[i], Z[i], start, n)


@lean
def cholesky(F, J, s, count, ridge):
    """Factor ``S + ridge I = L L'``; L goes below the diagonal of S, the inverse of its diagonal to INVERSE."""
    S = F[s.S : s.S + s.rows]
    for k in range(count):
        pivot = S[k, k] + ridge - dot(S[k], S[k], 0, k)
        F[ws.INVERSE, k] = 1.0 / sqrt(max(pivot, 1e-300))
        for a in range(k + 1, count):
            S[a, k] = (S[k, a] - dot(S[a], S[k], 0, k)) * F[ws.INVERSE, k]


@lean
def cholesky_solve(F, J, s, count, y):
    """Overwrite y with ``(L L')^-1 y``."""
    S = F[s.S : s.S + s.rows]
    for k in range(count):
        y[k] = (y[k] - dot(S[k], y, 0, k)) * F[ws.INVERSE, k]
    for k in range(count - 1, -1, -1):
        y[k] *= F[ws.INVERSE, k]
        add(y, -y[k], S[k], 0, k)


@lean
def gram(F, J, s, count, start):
    """Write ``R R'`` over the columns from ``start`` on above and on the diagonal of S; return its trace."""
    R = F[s.R : s.R + s.rows]
    S = F[s.S : s.S + s.rows]
    n, trace = s.n, 0.0
    for a in range(count):
        for b in range(a, count):
            S[a, b] = dot(R[a], R[b], start, n)
        trace += S[a, a]
    return trace


@lean
def rows_in_basis(F, J, s, start):
    """Compute ``R = A Z`` for the rows in the cost (0 for the others), in the columns from ``start`` on."""
    Z = F[s.Z : s.Z + s.h]
    A = F[s.A : s.A + s.rows]
    R = F[s.R : s.R + s.rows]
    n = s.n
    for a in range(s.rows):
        row = R[a]
        clear(row, start, n)
        if J[ws.IN_COST, a] != 0:
            for i in range(J[ws.NONZERO, a], J[ws.NONZERO_END, a]):
                if A[a, i] != 0.0:
                    add(row, A[a, i], Z[i], start, n)


@lean
def factor_active_rows(F, J, s):
    """Rotate the active hard rows into the columns [first_active, first_free); dependent rows become inactive.

    The row that is farthest out of the span of those before it comes first (pivoted QR of ``N_q Z / |N_q|``).
    """
    Z = F[s.Z : s.Z + s.h]
    h, n = s.h, s.n
    for q in range(h):
        J[ws.PENDING, q] = J[ws.ACTIVE, q] != 0
    s.first_free = s.first_active
    while s.first_free < n:
        best, which = -1.0, int64(-1)
        for q in range(h):
            if J[ws.PENDING, q] != 0:
                # squared distance of the unit row from the span of frozen rows and of the pivots so far
                outside = dot(Z[q], Z[q], s.first_free, n) / F[ws.HARD_NORM, q] ** 2
                if outside > best:
                    best, which = outside, q
        if not best > s.rank_tol**2:
            break
        scale = reflection(Z[which], s.first_free, n, F[ws.WORK])
        reflect(Z, 0, h, F[ws.WORK], scale, s.first_free, n)
        J[ws.PENDING, which] = 0
        J[ws.ACTIVE_ROW, s.first_free - s.first_active] = which
        s.first_free += 1
    for q in range(h):
        if J[ws.PENDING, q] != 0:
            J[ws.ACTIVE, q] = 0


@lean
def longest_column(F, J, s, k):
    """Return the longest free column of R from row k down, and its square."""
    R = F[s.R : s.R + s.rows]
    squares = F[ws.WORK]
    clear(squares, s.first_free, s.n)
    for a in range(k, s.rows):
        add_squares(squares, R[a], s.first_free, s.n)
    best, which = -1.0, int64(-1)
    for j in range(s.first_free, s.n):
        if squares[j] > best:
            best, which = squares[j], j
    return which, best


@lean
def eliminate(F, J, s, k, which, norm):
    """Apply the k-th reflection from the left, after which a column of R is 0 under row k."""
    R = F[s.R : s.R + s.rows]
    v, product = F[s.V + k], F[ws.WORK]
    n, m, head = s.n, s.rows, R[k, which]
    clear(v, 0, k)
    clear(product, s.first_free, n)
    v[k] = head + (-norm if head < 0.0 else norm)
    for a in range(k + 1, m):
        v[a] = R[a, which]
    # R <- R - scale v (v' R)
    for a in range(k, m):
        add(product, v[a], R[a], s.first_free, n)
    scale = 1.0 / (norm * (norm + abs(head)))
    for a in range(k, m):
        add(R[a], -scale * v[a], product, s.first_free, n)
    for a in range(k + 1, m):
        R[a, which] = 0.0
    F[ws.SCALE, k], J[ws.PIVOT, k] = scale, which


@lean
def factor_level_rows(F, J, s):
    """Factor the rows in the cost within the free columns: ``Q' (A Z) = R`` by reflections with column pivoting.

    It ends at the first pivot under the rank tolerance. With damping, ``R R' + damping I`` is factored too.
    """
    s.factorizations += 1
    rows_in_basis(F, J, s, s.first_free)
    s.rank = 0
    while s.rank < min(s.n - s.first_free, s.rows):
        which, square = longest_column(F, J, s, s.rank)
        norm = sqrt(max(square, 0.0))
        if not norm > s.rank_tol * s.size:
            break
        eliminate(F, J, s, s.rank, which, norm)
        s.rank += 1
    if s.damping > 0.0:
        gram(F, J, s, s.rank, s.first_free)
        cholesky(F, J, s, s.rank, s.damping + FACTOR_RIDGE * s.size**2)


@lean
def freeze_columns(F, J, s):
    """Take what is frozen out of the basis: the columns of the active rows and the row space of the level's factor."""
    Z = F[s.Z : s.Z + s.h]
    R = F[s.R : s.R + s.rows]
    h, n = s.h, s.n
    s.first_active = s.first_free + s.rank
    # without free columns no level below is solved, so nothing reads the basis any more
    if s.first_active == n:
        return
    for k in range(s.rank):
        at = s.first_free + k
        scale = reflection(R[k], at, n, F[ws.WORK])
        reflect(Z, 0, h, F[ws.WORK], scale, at, n)
        reflect(R, k + 1, s.rank, F[ws.WORK], scale, at, n)
