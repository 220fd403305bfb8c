"""The arrays and numbers of one hierarchy in the CPU kernel, and what is done with single rows of them.

All functions of the kernel take three things: ``F``, whose first rows are vectors (``F[ws.X]``) and whose others are
matrices (``F[s.Z : s.Z + s.h]``); ``J``, rows of integers; and ``s``, a record of numbers. Few arrays and no array
expressions keep the time down that Numba takes to compile.

The columns of ``Z`` are an orthonormal basis, in three groups:

    [0, s.first_active)             what the levels above have frozen: x does not move along these any more
    [s.first_active, s.first_free)  spanned by the active hard rows of this level
    [s.first_free, n)               free: the level's rows are factored within these columns

Z has a row for each hard row q, ``N_q Z``: for the box these are the rows of Z itself, so that bounds and general rows
are treated alike.
"""

from __future__ import annotations

import numpy as np

from ._frame import compiled, lean
from ._vectors import BEYOND, dot

# rows of F, of the variables (START: x where the level above ended; WORK: a reflector, or coordinates in the basis;
# DOWNHILL: the negative gradient in the basis; CURVATURE: how much a variable bends the rows of the levels so far)
X, START, STEP, WORK, DOWNHILL, CURVATURE = range(6)
# rows of F, of the hard rows
HARD_LOWER, HARD_UPPER, HARD_NORM, MULTIPLIER = range(6, 10)
# rows of F, of the level's rows (RIGHT: a right-hand side; SCALE: of the reflections of their factor; INVERSE: of the
# diagonal of a Cholesky factor)
LOWER, UPPER, ROW_NORM, VALUE, SLACK, RATE, RIGHT, SCALE, INVERSE = range(10, 19)
VECTORS = 19
# rows of J, of the hard rows (ACTIVE: -1 at the lower bound, 1 at the upper, 0 inactive; ACTIVE_ABOVE: where the level
# above ended; PENDING: not yet factored, or a copy; FREEZES: this level freezes it; LEVEL_OF: -1 for the box)
ACTIVE, ACTIVE_ABOVE, FROZEN, PENDING, FREEZES, LEVEL_OF = range(6)
# rows of J, of the level's rows (IN_COST: an equality or outside its interval; OWN: on which side, -1 below, 1 above, 2
# an equality; PIVOT: column of R; numbers that are not 0 are in the columns [NONZERO, NONZERO_END))
EQUALITY, IN_COST, OWN, PIVOT, NONZERO, NONZERO_END = range(6, 12)
# rows of J, of the variables, and of the columns of the basis (ACTIVE_ROW: hard row of column s.first_active + k)
ACTIVE_BOUND, ACTIVE_ROW = range(12, 14)
INTEGERS = 14

_WHOLE = "n h m Z A R V S hard level rows first_active first_free rank changes factorizations has_inequalities"
_REAL = (
    "size longest_square frobenius damping unmet demand x_max slack_norm root_cost gradient_norm residual "
    "rank_tol step_tol multiplier_tol feasible_tol"
)
SCALARS = np.dtype([(a, np.int64) for a in _WHOLE.split()] + [(a, np.float64) for a in _REAL.split()], align=True)
"""The record.

- Sizes: n variables, h hard rows, m rows of the longest level.
- Rows of F where its matrices begin: Z the basis (h, n); A the level's rows (m, n); R their triangular factor in the
  columns of Z (m, n); V its reflections from the left, one a row (m, m); S a square matrix above its diagonal and its
  Cholesky factor below (m, m); hard rows beside the box (h - n, n).
- The level at work: its number, how many rows it has, the rank of those in its cost, the norm of its longest row (size)
  and of all (frobenius), its damping and what that is computed from (unmet, demand).
- At x: the largest absolute variable, the norm of the slack, the root of twice the cost, the norm of the gradient, and
  what is left of it in the free columns (residual).
"""


@compiled
def workspace(s):
    """Return the float and integer arrays of one problem; ``s`` gets the rows where the matrices begin."""
    s.Z = VECTORS
    s.A = s.Z + s.h
    s.R, s.V, s.S = s.A + s.m, s.A + 2 * s.m, s.A + 3 * s.m
    s.hard = s.S + s.m
    rows, width = s.hard + s.h - s.n, max(s.n, s.h, s.m)
    floats = np.zeros(rows * width + BEYOND)
    return floats[: rows * width].reshape((rows, width)), np.zeros((INTEGERS, width), np.int32)


@lean
def copy(a, b, count):
    """Copy the first numbers of a to b."""
    for j in range(count):
        b[j] = a[j]


@lean
def clear(a, start, stop):
    """Set some columns to 0."""
    for j in range(start, stop):
        a[j] = 0


@lean
def clip(a, low, high):
    """Return the nearest point of an interval."""
    return min(max(a, low), high)


@lean
def hard_value(F, J, s, q, d):
    """Return hard row q times d: the rows of the box are those of the identity."""
    hard_rows = F[s.hard : s.hard + s.h - s.n]
    n = s.n
    return d[q] if q < n else dot(hard_rows[q - n], d, 0, n)


@lean
def target(F, J, a, value):
    """Return the nearest point of the interval of the level's row a; of an equality, its bound."""
    return F[LOWER, a] if J[EQUALITY, a] != 0 else clip(value, F[LOWER, a], F[UPPER, a])
