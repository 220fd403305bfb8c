"""One level of a hierarchy: its numbers, its factors within an orthonormal basis, and what is read off them.

``Z`` has that basis in its columns, in three groups:

    [0, first)     what the levels above have decided: x does not move along these any more
    [first, open)  spanned by the active rows, the hard rows that this level holds at a bound
    [open, n)      free: the level's rows are factored within these columns

A Householder reflection from the right turns columns among each other, so that a row gets all its length into one
column. A row of ``Z`` for each hard row, ``N_q Z``, makes box and general rows one thing.

Everything of one problem is in three things, which all functions take: ``F``, whose first rows are vectors (``F[X]``)
and whose others are matrices (``F[s.Z : s.Z + s.h]``); ``J``, rows of integers; and ``s``, a record of numbers. Few
arrays and no array expressions keep the time down that Numba takes to compile.
"""

from __future__ import annotations

from math import isnan, sqrt

import numpy as np
from numba import int64

from ._frame import compiled, lean
from ._vectors import BEYOND, add, add_squares, dot

_RIDGE = 1e-14  # of the longest row, squared: keeps the damped factor positive

# vectors in F: of the variables (START where the level above ended; TURN a reflection, or coordinates in the basis;
# PULL downhill in the basis; BENT how much a variable bends the rows of the levels so far),
X, START, STEP, TURN, PULL, BENT = range(6)
# of the hard rows,
LOW, HIGH, LENGTH, MULTIPLIER = range(6, 10)
# and of the level's rows (SCALE of the reflections of their factor, INVERSE of a Cholesky factor's diagonal)
BELOW, ABOVE, NORM, VALUE, SLACK, RATE, RIGHT, SCALE, INVERSE = range(10, 19)
VECTORS = 19
# rows of J: of the hard rows (SIDE -1 where active at the lower bound, 1 at the upper; CARRIED from the level above),
SIDE, CARRIED, FROZEN, WAITS, TIGHT, LEVEL_OF = range(6)
# of the level's rows (COUNTS in its cost; OWN how: -1 below the interval, 1 above, 2 an equality; PIVOT a column of R;
# what is not 0 is in the columns [SINCE, UNTIL)),
EQUAL, COUNTS, OWN, PIVOT, SINCE, UNTIL = range(6, 12)
# of the variables; and the hard row that column first + k is for
BOX, HELD = range(12, 14)
INTEGERS = 14

_WHOLE = "n h m Z A R V S hard level rows first open rank changes factorizations mixed"
_REAL = (
    "size longest frobenius damping unmet demand reach missed missing steepness residual "
    "rank_tol step_tol multiplier_tol feasible_tol"
)
SCALARS = np.dtype([(a, np.int64) for a in _WHOLE.split()] + [(a, np.float64) for a in _REAL.split()], align=True)
"""The record: sizes (n variables, h hard rows, m rows of the longest level), where the matrices of F begin (Z the basis
(h, n), A the level's rows (m, n), R their triangular factor in the columns of Z (m, n), V its reflections from the
left, one a row (m, m), S a square matrix above its diagonal and its Cholesky factor below (m, m), hard rows beside the
box), the level at work, and what is known of it."""


@compiled
def workspace(s):
    """Float and integer arrays of one problem; ``s`` gets the rows where the matrices begin."""
    s.Z = VECTORS
    s.A = s.Z + s.h
    s.R, s.V, s.S = s.A + s.m, s.A + 2 * s.m, s.A + 3 * s.m
    s.hard = s.S + s.m
    rows, width = s.hard + s.h - s.n, max(s.n, s.h, s.m)
    floats = np.zeros(rows * width + BEYOND)
    return floats[: rows * width].reshape((rows, width)), np.zeros((INTEGERS, width), np.int32)


@lean
def copy(a, b, count):
    """``b = a`` in the first columns."""
    for j in range(count):
        b[j] = a[j]


@lean
def clear(a, start, stop):
    """0 in some columns."""
    for j in range(start, stop):
        a[j] = 0


@lean
def clip(a, low, high):
    """The nearest point of an interval."""
    return min(max(a, low), high)


@lean
def reflection(row, at, n, turn):
    """The vector v of ``I - scale v v'``, which takes a row's columns from ``at`` on into that one; and its scale."""
    norm = sqrt(dot(row, row, at, n))
    for j in range(at, n):
        turn[j] = row[j]
    head = row[at]
    turn[at] = head + (-norm if head < 0.0 else norm)
    return 1.0 / (norm * (norm + abs(head)))


@lean
def reflect(rows, first_row, stop_row, turn, scale, at, n):
    """Some rows times ``I - scale v v'``."""
    for q in range(first_row, stop_row):
        row = rows[q]
        by = scale * dot(row, turn, at, n)
        if by != 0.0:
            add(row, -by, turn, at, n)


@lean
def from_basis(F, J, s, start, stop, out):
    """``out = Z turn``, over some columns."""
    Z = F[s.Z : s.Z + s.h]
    for i in range(s.n):
        out[i] = dot(Z[i], F[TURN], start, stop)


@lean
def to_basis(F, J, s, start, a, out):
    """``out = Z' a``, in the columns from ``start`` on."""
    Z = F[s.Z : s.Z + s.h]
    n = s.n
    clear(out, start, s.n)
    for i in range(n):
        if a[i] != 0.0:
            add(out, a[i], Z[i], start, n)


@lean
def hard_value(F, J, s, q, d):
    """Hard row q times d."""
    hard_rows = F[s.hard : s.hard + s.h - s.n]
    n = s.n
    return d[q] if q < n else dot(hard_rows[q - n], d, 0, n)


@lean
def cholesky(F, J, s, count, ridge):
    """``L L' = S + ridge I``; L goes below the diagonal of S, the inverse of its diagonal to ``inverse``."""
    S = F[s.S : s.S + s.rows]
    for k in range(count):
        pivot = S[k, k] + ridge - dot(S[k], S[k], 0, k)
        F[INVERSE, k] = 1.0 / sqrt(max(pivot, 1e-300))
        for a in range(k + 1, count):
            S[a, k] = (S[k, a] - dot(S[a], S[k], 0, k)) * F[INVERSE, k]


@lean
def cholesky_solve(F, J, s, count, y):
    """``y <- (L L')^-1 y``."""
    S = F[s.S : s.S + s.rows]
    for k in range(count):
        y[k] = (y[k] - dot(S[k], y, 0, k)) * F[INVERSE, k]
    for k in range(count - 1, -1, -1):
        y[k] *= F[INVERSE, k]
        add(y, -y[k], S[k], 0, k)


@lean
def gram(F, J, s, count, start):
    """Above and on the diagonal of S, ``R R'`` over the columns from ``start`` on; its trace."""
    R = F[s.R : s.R + s.rows]
    S = F[s.S : s.S + s.rows]
    n, trace = s.n, 0.0
    for a in range(count):
        for b in range(a, count):
            S[a, b] = dot(R[a], R[b], start, n)
        trace += S[a, a]
    return trace


@lean
def project(F, J, s, start):
    """``R = A Z`` for the rows that count (0 for the others), in the columns from ``start`` on."""
    Z = F[s.Z : s.Z + s.h]
    A = F[s.A : s.A + s.rows]
    R = F[s.R : s.R + s.rows]
    n = s.n
    for a in range(s.rows):
        row = R[a]
        clear(row, start, n)
        if J[COUNTS, a] != 0:
            for i in range(J[SINCE, a], J[UNTIL, a]):
                if A[a, i] != 0.0:
                    add(row, A[a, i], Z[i], start, n)


@lean
def hold(F, J, s):
    """Rotates the active hard rows into the columns [first, open); rows that depend on others are let go.

    The one that stands farthest out of those before it comes first (pivoted QR of ``N_q Z / |N_q|``).
    """
    Z = F[s.Z : s.Z + s.h]
    h, n = s.h, s.n
    for q in range(h):
        J[WAITS, q] = J[SIDE, q] != 0
    s.open = s.first
    while s.open < n:
        best, which = -1.0, int64(-1)
        for q in range(h):
            if J[WAITS, q] != 0:
                far = dot(Z[q], Z[q], s.open, n) / F[LENGTH, q] ** 2
                if far > best:
                    best, which = far, q
        if not best > s.rank_tol**2:
            break
        scale = reflection(Z[which], s.open, n, F[TURN])
        reflect(Z, 0, h, F[TURN], scale, s.open, n)
        J[WAITS, which] = 0
        J[HELD, s.open - s.first] = which
        s.open += 1
    for q in range(h):
        if J[WAITS, q] != 0:
            J[SIDE, q] = 0


@lean
def longest_column(F, J, s, k):
    """Of R from row k down, in the free columns: which one, and its square."""
    R = F[s.R : s.R + s.rows]
    squares = F[TURN]
    clear(squares, s.open, s.n)
    for a in range(k, s.rows):
        add_squares(squares, R[a], s.open, s.n)
    best, which = -1.0, int64(-1)
    for j in range(s.open, s.n):
        if squares[j] > best:
            best, which = squares[j], j
    return which, best


@lean
def eliminate(F, J, s, k, which, norm):
    """The k-th reflection from the left: a column of R is 0 under row k."""
    R = F[s.R : s.R + s.rows]
    v, product = F[s.V + k], F[TURN]
    n, m, head = s.n, s.rows, R[k, which]
    clear(v, 0, k)
    clear(product, s.open, n)
    v[k] = head + (-norm if head < 0.0 else norm)
    for a in range(k + 1, m):
        v[a] = R[a, which]
    for a in range(k, m):
        add(product, v[a], R[a], s.open, n)
    scale = 1.0 / (norm * (norm + abs(head)))
    for a in range(k, m):
        add(R[a], -scale * v[a], product, s.open, n)
    for a in range(k + 1, m):
        R[a, which] = 0.0
    F[SCALE, k], J[PIVOT, k] = scale, which


@lean
def fit(F, J, s):
    """Factors the rows that count within the free columns: ``Q' (A Z) = R`` by reflections with column pivoting.

    Pivots under the rank tolerance end it. With damping, ``R R' + damping I`` is factored too.
    """
    s.factorizations += 1
    project(F, J, s, s.open)
    s.rank = 0
    while s.rank < min(s.n - s.open, s.rows):
        which, square = longest_column(F, J, s, s.rank)
        norm = sqrt(max(square, 0.0))
        if not norm > s.rank_tol * s.size:
            break
        eliminate(F, J, s, s.rank, which, norm)
        s.rank += 1
    if s.damping > 0.0:
        gram(F, J, s, s.rank, s.open)
        cholesky(F, J, s, s.rank, s.damping + _RIDGE * s.size**2)


@lean
def least_squares(F, J, s):
    """The step d in the free columns that makes ``1/2 |slack + A d|^2 + 1/2 damping |x + d|^2`` least.

    Without damping, ``R d = -Q' slack`` in the pivots' columns. With it, ``x + d = R' y`` there, with
    ``(R R' + damping I) y = R x - Q' slack``.
    """
    R = F[s.R : s.R + s.rows]
    V = F[s.V : s.V + s.rows]
    n, m, y = s.n, s.rows, F[RIGHT]
    for a in range(m):
        y[a] = -F[SLACK, a] if J[COUNTS, a] != 0 else 0.0
    for k in range(s.rank):
        add(y, -F[SCALE, k] * dot(V[k], y, k, m), V[k], k, m)
    if s.damping > 0.0:
        to_basis(F, J, s, s.open, F[X], F[PULL])
        for k in range(s.rank):
            y[k] += dot(R[k], F[PULL], s.open, n)
        cholesky_solve(F, J, s, s.rank, y)
        for j in range(s.open, n):
            F[TURN, j] = -F[PULL, j]
        for k in range(s.rank):
            add(F[TURN], y[k], R[k], s.open, n)
    else:
        clear(F[TURN], s.open, n)
        for k in range(s.rank - 1, -1, -1):
            z = y[k] / R[k, J[PIVOT, k]]
            F[TURN, J[PIVOT, k]] = z
            for b in range(k):
                y[b] -= R[b, J[PIVOT, k]] * z
    from_basis(F, J, s, s.open, n, F[STEP])


@lean
def restore(F, J, s):
    """The shortest step that brings the active rows to their bounds: ``(N Z) t = bound - N x`` by substitution."""
    Z = F[s.Z : s.Z + s.h]
    for k in range(s.open - s.first):
        q = J[HELD, k]
        gap = (F[LOW, q] if J[SIDE, q] < 0 else F[HIGH, q]) - hard_value(F, J, s, q, F[X])
        j = s.first + k
        F[TURN, j] = (gap - dot(Z[q], F[TURN], s.first, j)) / Z[q, j]
    from_basis(F, J, s, s.first, s.open, F[STEP])


@lean
def judge(F, J, s):
    """Multipliers of the active rows, ``sum_q N_q multiplier_q = -gradient`` in their columns, and stationarity.

    ``pull = -Z' gradient``; what of it is left in the free columns is the residual.
    """
    Z = F[s.Z : s.Z + s.h]
    A = F[s.A : s.A + s.rows]
    n = s.n
    gradient = F[STEP]
    for i in range(n):
        gradient[i] = s.damping * F[X, i]
    for a in range(s.rows):
        if J[COUNTS, a] != 0:
            add(gradient, F[SLACK, a], A[a], 0, n)
    s.steepness = sqrt(dot(gradient, gradient, 0, n))
    to_basis(F, J, s, s.first, gradient, F[PULL])
    s.residual = 0.0
    for j in range(s.first, n):
        F[PULL, j] = -F[PULL, j]
        if j >= s.open:
            s.residual = max(s.residual, abs(F[PULL, j]))
        F[TURN, j] = F[PULL, j]
    clear(F[MULTIPLIER], 0, s.h)
    for k in range(s.open - s.first - 1, -1, -1):
        q, j = J[HELD, k], s.first + k
        F[MULTIPLIER, q] = F[TURN, j] / Z[q, j]
        add(F[TURN], -F[MULTIPLIER, q], Z[q], s.first, j)


@lean
def look(F, J, s):
    """Values and slacks of the level at x, their norm, and the root of twice its cost."""
    A = F[s.A : s.A + s.rows]
    n = s.n
    s.reach = square = 0.0
    for i in range(n):
        s.reach = F[X, i] if isnan(F[X, i]) else max(s.reach, abs(F[X, i]))
    for a in range(s.rows):
        F[VALUE, a] = dot(A[a], F[X], 0, n)
        near = F[BELOW, a] if J[EQUAL, a] != 0 else clip(F[VALUE, a], F[BELOW, a], F[ABOVE, a])
        F[SLACK, a] = F[VALUE, a] - near
        square += F[SLACK, a] ** 2
    s.missed = sqrt(square)
    s.missing = sqrt(square + s.damping * dot(F[X], F[X], 0, n))


@lean
def roundoff(s):
    """Slopes of the level's cost under this are roundoff."""
    return s.size * s.step_tol * (s.size * s.reach + s.missing)


@lean
def sign_tolerance(s):
    """A multiplier has the wrong sign where it is wrong by more than this."""
    return s.multiplier_tol * s.steepness + roundoff(s)


@lean
def is_stationary(s):
    """Whether what is left of the gradient in the free columns is roundoff."""
    return s.residual <= 10.0 * (s.multiplier_tol * s.size * s.missing + roundoff(s))
