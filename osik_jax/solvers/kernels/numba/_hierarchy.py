"""A hierarchy of least squares, level after level, on a CPU: the candidate that ``solvers/hqp`` certifies.

Level k minimises ``1/2 |dist(A x, [l, u])|^2 + 1/2 damping |x|^2`` over the minimisers of the levels above it, inside
the hard rows: the box and the rows of earlier levels that hold inequalities. What is solved, and how a level is judged,
is that of ``_cascade.py``, ``_primal.py`` and ``_landing.py`` in ``solvers/hqp``; here with one orthonormal basis.

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

from math import inf, isfinite, isnan, sqrt

import numpy as np
from numba import int64

from ..._damping import BENDS, LEAST, PASSES, ROOM, SPENT
from ._frame import arguments, compiled, doubles, integers, is_call, lean, results, size
from ._vectors import SLACK, add, add_squares, dot

_ATTEMPTS = 4  # at a working-set guess, before the primal active set takes over
_PATIENCE = 20  # steps of no length, before the least index decides
_WEAK = 1e-9  # of the longest row, squared: the damping of a step along directions that the factor left out
_RIDGE = 1e-14  # of the longest row, squared: keeps the damped factor positive
_DEMAND_RIDGE = 1e-13  # of the rows' squares: the same, where a level's damping is found

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
# of the level's rows (COUNTS in its cost; OWN how: -1 below the interval, 1 above, 2 an equality; PIVOT a column of R),
EQUAL, COUNTS, OWN, PIVOT = range(6, 10)
# of the variables; and the hard row that column first + k is for
BOX, HELD = range(10, 12)
INTEGERS = 12

_WHOLE = "n h m Z A R V S hard level rows first open rank changes factorizations mixed"
_REAL = (
    "size longest frobenius damping unmet demand reach missed missing steepness residual "
    "rank_tol step_tol multiplier_tol feasible_tol"
)
_SCALARS = np.dtype([(a, np.int64) for a in _WHOLE.split()] + [(a, np.float64) for a in _REAL.split()], align=True)
"""The record: sizes (n variables, h hard rows, m rows of the longest level), where the matrices of F begin (Z the basis
(h, n), A the level's rows (m, n), R their triangular factor in the columns of Z (m, n), V its reflections from the
left, one a row (m, m), S a square matrix above its diagonal and its Cholesky factor below (m, m), hard rows beside the
box), the level at work, and what is known of it."""


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
    S = S
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
            for i in range(n):
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
def fit(F, J, s):
    """Factors the rows that count within the free columns: ``Q' (A Z) = R`` by reflections with column pivoting.

    Pivots under the rank tolerance end it. With damping, ``R R' + damping I`` is factored too.
    """
    R = F[s.R : s.R + s.rows]
    V = F[s.V : s.V + s.rows]
    n, m, R = s.n, s.rows, R
    s.factorizations += 1
    project(F, J, s, s.open)
    s.rank = 0
    while s.rank < min(n - s.open, m):
        k = s.rank
        clear(F[TURN], s.open, n)  # squares of the columns, from row k down
        for a in range(k, m):
            add_squares(F[TURN], R[a], s.open, n)
        best, which = -1.0, int64(-1)
        for j in range(s.open, n):
            if F[TURN, j] > best:
                best, which = F[TURN, j], j
        norm = sqrt(max(best, 0.0))
        if not norm > s.rank_tol * s.size:
            break
        v, head = V[k], R[k, which]
        for a in range(m):
            v[a] = R[a, which] if a > k else 0.0
        v[k] = head + (-norm if head < 0.0 else norm)
        F[SCALE, k], J[PIVOT, k] = 1.0 / (norm * (norm + abs(head))), which
        clear(F[TURN], s.open, n)
        for a in range(k, m):
            add(F[TURN], F[SCALE, k] * v[a], R[a], s.open, n)
        for a in range(k, m):
            add(R[a], -v[a], F[TURN], s.open, n)
        for a in range(k + 1, m):
            R[a, which] = 0.0
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


@lean
def may_block(F, J, s, q):
    """Whether a hard row can stop this level: not frozen, and of the box or of a level above."""
    return J[FROZEN, q] == 0 and J[LEVEL_OF, q] < s.level


@lean
def level_damping(F, J, s, constant):
    """``constant + unmet share``, share the part of the demand that the step with this very damping misses.

    The fixed point of ``solvers/_damping.py:effective``; 0 where its slopes would be roundoff.
    """
    A = F[s.A : s.A + s.rows]
    R = F[s.R : s.R + s.rows]
    n, m, least = s.n, s.rows, LEAST * s.longest
    damping = constant
    if s.unmet > least:
        share, before = 1.0, 0.0
        to_basis(F, J, s, s.first, F[X], F[TURN])
        from_basis(F, J, s, s.first, n, F[STEP])
        base, end = F[START], F[STEP]
        for i in range(n):
            base[i] = F[X, i] - F[STEP, i]
        for a in range(m):
            at = dot(A[a], base, 0, n)
            F[RATE, a] = (F[BELOW, a] if J[EQUAL, a] != 0 else clip(at, F[BELOW, a], F[ABOVE, a])) - at  # the goal
            J[COUNTS, a] = J[EQUAL, a] != 0 or F[RATE, a] != 0.0
        project(F, J, s, s.first)
        trace = gram(F, J, s, m, s.first)
        for _ in range(PASSES):
            if share == before or not s.unmet * share > least:
                break
            before = share
            ridge = constant + s.unmet * share + _DEMAND_RIDGE * trace
            cholesky(F, J, s, m, ridge if ridge > 0.0 else 1.0)
            copy(F[RATE], F[RIGHT], m)
            cholesky_solve(F, J, s, m, F[RIGHT])
            clear(F[TURN], s.first, n)
            for a in range(m):
                add(F[TURN], F[RIGHT, a], R[a], s.first, n)
            from_basis(F, J, s, s.first, n, end)
            for i in range(n):
                end[i] = clip(base[i] + end[i], F[LOW, i], F[HIGH, i])
            square = 0.0
            for a in range(m):
                at = dot(A[a], end, 0, n)
                near = F[BELOW, a] if J[EQUAL, a] != 0 else clip(at, F[BELOW, a], F[ABOVE, a])
                square += (at - near) ** 2
            share = min(sqrt(square) / (s.demand if s.demand > 0.0 else 1.0), 1.0)
        damping = constant + s.unmet * share
    return damping if damping > least else 0.0


@lean
def usable(at, low, high):
    """The side of a working-set guess, 0 where its bound does not exist."""
    if at < 0 and isfinite(low):
        return -1
    return 1 if at > 0 and isfinite(high) else 0


@lean
def solve_on_working_set(F, J, s):
    """The minimiser of the level with the active rows at their bounds and the rows that count as near as can be."""
    copy(F[START], F[X], s.n)
    for a in range(s.rows):
        J[COUNTS, a] = J[OWN, a] != 0
    hold(F, J, s)
    fit(F, J, s)
    for _ in range(2):  # once more against exact residuals
        restore(F, J, s)
        add(F[X], 1.0, F[STEP], 0, s.n)
        own_slack(F, J, s)
        least_squares(F, J, s)
        add(F[X], 1.0, F[STEP], 0, s.n)
    look(F, J, s)
    own_slack(F, J, s)
    s.missing = sqrt(dot(F[SLACK], F[SLACK], 0, s.rows) + s.damping * dot(F[X], F[X], 0, s.n))


@lean
def own_slack(F, J, s):
    """Slacks of the rows that count, from the side that they count on."""
    A = F[s.A : s.A + s.rows]
    for a in range(s.rows):
        goal = F[ABOVE, a] if J[OWN, a] == 1 else F[BELOW, a]
        F[SLACK, a] = dot(A[a], F[X], 0, s.n) - goal if J[COUNTS, a] != 0 else 0.0


@lean
def improve_working_set(F, J, s):
    """Holds what is violated, releases what pulls, and lets rows count that miss their interval; all at once.

    Returns:
        Whether the point is feasible, whether the rows of the level count on the right sides, whether the signs of
        the multipliers are right, and how many changes were made.
    """
    feasible, consistent, signs, turned = True, True, True, 0
    tolerance = sign_tolerance(s)
    for q in range(s.h):
        if J[SIDE, q] != 0:
            if -F[MULTIPLIER, q] * J[SIDE, q] * F[LENGTH, q] > tolerance:
                J[SIDE, q], signs, turned = 0, False, turned + 1
        elif may_block(F, J, s, q):
            at = hard_value(F, J, s, q, F[X])
            near = s.feasible_tol * (F[LENGTH, q] * s.reach + abs(at))
            if not max(F[LOW, q] - at, at - F[HIGH, q]) <= near:
                J[SIDE, q], feasible, turned = (-1 if at < F[LOW, q] else 1), False, turned + 1
    for a in range(s.rows):
        near = s.feasible_tol * (F[NORM, a] * s.reach + abs(F[VALUE, a]))
        under, over, own = F[BELOW, a] - F[VALUE, a], F[VALUE, a] - F[ABOVE, a], J[OWN, a]
        right = own == 2 or (max(under, over) <= near if own == 0 else (under if own < 0 else over) >= -near)
        if not right:
            J[OWN, a] = 0 if own != 0 else (-1 if under > over else 1)
            consistent, turned = False, turned + 1
    return feasible, consistent, signs, turned


@lean
def try_guess(F, J, s, guess_hard, guess_own):
    """The minimiser on a guessed working set; where it is not the optimum, on what it shows to be better, a few times.

    Where none is the optimum, the last one is the start of the primal active set if it is feasible, else the point
    where the level above ended. (M. Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a
    semismooth Newton method", 2003.)

    Returns:
        Whether it is the optimum, and whether the factors are those of the working set.
    """
    h = s.h
    copy(J[SIDE], J[CARRIED], h)
    for q in range(h):
        J[SIDE, q] = usable(guess_hard[q], F[LOW, q], F[HIGH, q]) if may_block(F, J, s, q) else 0
    for a in range(s.rows):
        J[OWN, a] = 2 if J[EQUAL, a] != 0 else usable(guess_own[a], F[BELOW, a], F[ABOVE, a])
    feasible = False
    for attempt in range(_ATTEMPTS):
        solve_on_working_set(F, J, s)
        if not isfinite(s.reach):
            feasible = False
            break
        judge(F, J, s)
        copy(J[SIDE], J[WAITS], h)
        feasible, consistent, signs, turned = improve_working_set(F, J, s)
        if feasible and consistent and signs and is_stationary(s):
            return True, True
        if turned == 0 or attempt + 1 == _ATTEMPTS:
            copy(J[WAITS], J[SIDE], h)
            break
        s.changes += turned
    if not feasible:
        copy(F[START], F[X], s.n)
        copy(J[CARRIED], J[SIDE], h)
    return False, feasible


@lean
def line_slope(F, J, s, t, along_x, along_d):
    """The derivative at t of the level's cost along ``x + t d``."""
    total = along_x + t * along_d
    for a in range(s.rows):
        at = F[VALUE, a] + t * F[RATE, a]
        near = F[BELOW, a] if J[EQUAL, a] != 0 else clip(at, F[BELOW, a], F[ABOVE, a])
        total += F[RATE, a] * (at - near)
    return total


@lean
def line_search(F, J, s, along_x, along_d):
    """The t >= 0 that makes the level's cost least along ``x + t d``: convex, and quadratic between knots.

    Knots are where a row enters or leaves its interval. Between the last one with a falling slope and the next, the
    slope is a straight line.
    """
    before, after = 0.0, inf
    for which in range(2):  # first the last knot with a falling slope, then the one after it
        for a in range(-1, 2 * s.rows):
            knot = 1.0
            if a >= 0:
                row = a // 2
                bound = F[BELOW, row] if a % 2 == 0 else F[ABOVE, row]
                if F[RATE, row] != 0.0 and isfinite(bound):
                    knot = max((bound - F[VALUE, row]) / F[RATE, row], 0.0)
            if which == 0 and knot > before and line_slope(F, J, s, knot, along_x, along_d) < 0.0:
                before = knot
            if which == 1 and knot > before:
                after = min(after, knot)
    probe = 0.5 * (before + after) if isfinite(after) else before + 1.0
    at_first, at_last = line_slope(F, J, s, before, along_x, along_d), line_slope(F, J, s, probe, along_x, along_d)
    if at_last > at_first:
        return max(before - at_first * (probe - before) / (at_last - at_first), 0.0)
    return before


@lean
def step_length(F, J, s):
    """How far the hard rows let the step go, and which of them stops it (the least index among equals)."""
    stride = sqrt(dot(F[STEP], F[STEP], 0, s.n))
    nearest, which, towards = inf, int64(-1), 0
    for q in range(s.h):
        if J[SIDE, q] == 0 and may_block(F, J, s, q):
            rate = hard_value(F, J, s, q, F[STEP])
            if abs(rate) > s.rank_tol * stride * F[LENGTH, q]:
                bound = F[HIGH, q] if rate > 0.0 else F[LOW, q]
                time = max((bound - hard_value(F, J, s, q, F[X])) / rate, 0.0)
                if time < nearest:
                    nearest, which, towards = time, q, (1 if rate > 0.0 else -1)
    return nearest, which, towards


@lean
def most_wrong(F, J, s, least_index):
    """The active row whose multiplier has the wrong sign by most, or the first of these; -1 for none."""
    tolerance, worst, which = sign_tolerance(s), 0.0, int64(-1)
    for q in range(s.h):
        if J[SIDE, q] != 0:
            wrong = -F[MULTIPLIER, q] * J[SIDE, q] * F[LENGTH, q]
            if wrong > tolerance and wrong > worst and not (least_index and which >= 0):
                worst, which = wrong, q
    return which


@lean
def primal_active_set(F, J, s, most, factored):
    """From a feasible point to the level's optimum, feasible all the way; whether it was found.

    Each iteration takes the least-squares step on the active rows to the first row that blocks it, which becomes
    active. Where the step vanishes, the row with the most wrongly signed multiplier is released; without one, the point
    is the optimum. Where it rests on a direction that the factor's tolerance left out, it takes one damped step there.
    """
    A = F[s.A : s.A + s.rows]
    n = s.n
    stalled, tried, to_hold, to_fit = 0, False, not factored, not factored
    for _ in range(most):
        look(F, J, s)
        if to_hold:
            hold(F, J, s)
        turned = to_hold or to_fit
        for a in range(s.rows):
            now = 1 if J[EQUAL, a] != 0 or F[SLACK, a] != 0.0 else 0
            turned = turned or now != J[COUNTS, a]
            J[COUNTS, a] = now
        if turned:
            fit(F, J, s)
        to_hold = to_fit = False
        least_squares(F, J, s)
        square = 0.0
        for a in range(s.rows):
            F[RATE, a] = dot(A[a], F[STEP], 0, n)
            square += F[RATE, a] ** 2 if J[COUNTS, a] != 0 else 0.0
        along_x, along_d = s.damping * dot(F[X], F[STEP], 0, n), s.damping * dot(F[STEP], F[STEP], 0, n)
        weak = False
        if sqrt(square + along_d) <= s.step_tol * (s.size * s.reach + s.missing):
            judge(F, J, s)
            weak = not tried and not is_stationary(s)
            if not weak:
                which = most_wrong(F, J, s, stalled > _PATIENCE)
                if which < 0:
                    return True
                J[SIDE, which] = 0
                to_hold = True
                s.changes += 1
                continue
            tried = True
            for j in range(s.open, n):
                F[TURN, j] = F[PULL, j] / (_WEAK * s.size**2 + s.damping)
            from_basis(F, J, s, s.open, n, F[STEP])
        limit, which, towards = step_length(F, J, s)
        ideal = line_search(F, J, s, along_x, along_d) if s.mixed != 0 and not weak else 1.0
        blocked = limit <= ideal
        share = limit if blocked else ideal
        moved = 0.0
        for i in range(n):
            moved = max(moved, share * abs(F[STEP, i]))
            F[X, i] += share * F[STEP, i]
        stalled = 0 if moved > 0.0 else stalled + 1
        if blocked:
            J[SIDE, which] = towards
            s.changes += 1
            to_hold, tried = True, False
    return False


@lean
def narrow_box(F, J, s, bends):
    """The box of the levels below: what they may spend of the progress of a level that is out of reach.

    ``room_below`` of ``solvers/_damping.py``: a motion d costs up to ``1/2 missed size sum_j bent_j d_j^2``.
    """
    n = s.n
    missed = min(s.missed, s.demand)
    share = missed / (s.demand if s.demand > 0.0 else 1.0)
    most, many = 0.0, 0
    for i in range(n):
        F[BENT, i] = max(F[BENT, i], bends[i] / (s.frobenius if s.frobenius > 0.0 else 1.0))
        most = max(most, missed * s.frobenius * F[BENT, i])
    if not s.unmet * share > LEAST * s.longest:
        return
    for i in range(n):
        many += missed * s.frobenius * F[BENT, i] > BENDS * most
    gain = SPENT * (s.demand - missed) * (s.demand + missed)
    for i in range(n):
        cost = missed * s.frobenius * F[BENT, i]
        if cost > BENDS * most:
            room = sqrt(gain / (many * cost)) + ROOM
            F[LOW, i], F[HIGH, i] = max(F[LOW, i], F[X, i] - room), min(F[HIGH, i], F[X, i] + room)


@lean
def freeze(F, J, s, hard_place, sides, tight, missed, own, multipliers):
    """What the level decides for those below: active rows that push, and its own rows that miss their interval.

    Both hold with the same values on the whole face of minimisers. A force that the damping explains does not count.

    Returns:
        The rank of the rows that count, for the decision.
    """
    h, n = s.h, s.n
    look(F, J, s)
    floor = sign_tolerance(s) + s.damping * sqrt(dot(F[X], F[X], 0, n))
    same, all_tight = True, True
    for a in range(s.rows):
        small = s.multiplier_tol * (F[NORM, a] * s.reach + s.missing)
        now = 1 if J[EQUAL, a] != 0 or abs(F[SLACK, a]) > small else 0
        same = same and now == J[COUNTS, a]
        J[COUNTS, a] = now
        missed[a] = (1 if F[SLACK, a] > 0.0 else -1) if now != 0 else 0
        own[a] = 2 if J[EQUAL, a] != 0 else missed[a]
    for q in range(h):
        J[TIGHT, q] = J[SIDE, q] != 0 and abs(F[MULTIPLIER, q]) * F[LENGTH, q] > floor
        all_tight = all_tight and (J[TIGHT, q] != 0) == (J[SIDE, q] != 0)
        sides[q], multipliers[q] = J[SIDE, q], F[MULTIPLIER, q]
    rank = s.rank
    if not (same and all_tight):
        for q in range(h):
            J[SIDE, q] = J[SIDE, q] if J[TIGHT, q] != 0 else 0
        hold(F, J, s)
        fit(F, J, s)
    tie = same and s.rank != rank and s.damping == 0.0  # more would count without the rows that do not push
    for q in range(h):
        tight[q] = sides[q] if J[TIGHT, q] != 0 or tie else 0
        if q < n:
            J[BOX, q] = sides[q] if sides[q] != 0 else (J[BOX, q] if J[FROZEN, q] != 0 else 0)
        elif J[LEVEL_OF, q] == s.level:
            at = hard_value(F, J, s, q, F[X])
            F[LOW, q], F[HIGH, q] = min(F[LOW, q], at), max(F[HIGH, q], at)
            J[FROZEN, q] = J[FROZEN, q] != 0 or J[COUNTS, hard_place[q - n]] != 0
        J[FROZEN, q] = J[FROZEN, q] != 0 or J[TIGHT, q] != 0
        J[SIDE, q] = 0 if J[TIGHT, q] != 0 else sides[q]
    return rank if tie else s.rank


@lean
def cut_off(F, J, s):
    """Takes what is decided out of the basis: the active rows' columns and the row space of the level's factor."""
    Z = F[s.Z : s.Z + s.h]
    R = F[s.R : s.R + s.rows]
    h, n = s.h, s.n
    for k in range(s.rank):
        at = s.open + k
        scale = reflection(R[k], at, n, F[TURN])
        reflect(Z, 0, h, F[TURN], scale, at, n)
        reflect(R, k + 1, s.rank, F[TURN], scale, at, n)
    s.first = s.open + s.rank


@lean
def begin_level(F, J, s, rows, lower, upper, equal, constant):
    """The level's numbers to the workspace."""
    A, n, total = F[s.A : s.A + s.rows], s.n, 0.0
    s.longest = 0.0
    for a in range(s.rows):
        for i in range(n):
            A[a, i] = rows[a * n + i]
        F[BELOW, a], F[ABOVE, a], J[EQUAL, a] = lower[a], upper[a], equal[a]
        square = dot(A[a], A[a], 0, n)
        F[NORM, a] = sqrt(square)
        s.longest, total = max(s.longest, square), total + square
    s.size, s.frobenius = sqrt(s.longest), sqrt(total)
    s.damping = level_damping(F, J, s, constant)
    s.size = max(s.size, sqrt(s.damping))
    copy(F[X], F[START], n)


@lean
def begin(F, J, s, hard, low, high, equal):
    """The box's nearest point to 0, and a basis of what its pinned variables leave: columns of the identity."""
    Z, hard_rows = F[s.Z : s.Z + s.h], F[s.hard : s.hard + s.h - s.n]
    h, n = s.h, s.n
    s.first, s.changes, s.factorizations = 0, 0, 0
    for q in range(h):
        clear(Z[q], 0, n)
        J[SIDE, q], J[FROZEN, q], F[LENGTH, q], F[LOW, q], F[HIGH, q] = 0, 0, 1.0, low[q], high[q]
    for i in range(n):
        F[BENT, i], F[X, i] = 0.0, clip(0.0, low[i], high[i])
        pinned = 1 if equal[i] != 0 else 0
        J[FROZEN, i], J[BOX, i] = pinned, 2 * pinned
        s.first += pinned
    column = s.first
    for i in range(n):
        if J[FROZEN, i] == 0:
            Z[i, column] = 1.0
            column += 1
    for q in range(n, h):
        row = hard_rows[q - n]
        for i in range(n):
            row[i] = hard[(q - n) * n + i]
        to_basis(F, J, s, s.first, row, Z[q])
        norm = sqrt(dot(row, row, 0, n))
        F[LENGTH, q] = norm if norm > 0.0 else 1.0


@compiled
def workspace(s):
    """Float and integer arrays of one problem; ``s`` gets the rows where the matrices begin."""
    s.Z = VECTORS
    s.A = s.Z + s.h
    s.R, s.V, s.S = s.A + s.m, s.A + 2 * s.m, s.A + 3 * s.m
    s.hard = s.S + s.m
    width = max(s.n, s.h, s.m)
    rows = s.hard + s.h - s.n
    return np.zeros(rows * width + SLACK)[: rows * width].reshape((rows, width)), np.zeros((INTEGERS, width), np.int32)


@lean
def how_many(a, stop):
    """How many of the first integers are not 0."""
    count = 0
    for j in range(stop):
        count += a[j] != 0
    return count


@compiled
def solve_all(given, found):
    """All problems of a batch; arguments and results, a row a problem, are those of ``solvers/hqp/_numba.py``."""
    batch, L = size(given, 0, 0), size(given, 0, 1)
    s = np.zeros(1, _SCALARS)[0]
    s.m, s.n, s.h = size(given, 0, 2), size(given, 0, 3), size(given, 4, 1)
    m, n, h = s.m, s.n, s.h
    o = batch - batch  # numbers of buffers that are no part of a type: one `doubles` is compiled, not one for each
    matrix, lower, upper = doubles(given, o, batch), doubles(given, o + 1, batch), doubles(given, o + 2, batch)
    hard, low, high = doubles(given, o + 3, batch), doubles(given, o + 4, batch), doubles(given, o + 5, batch)
    dampings, bends, shares = doubles(given, o + 6, batch), doubles(given, o + 7, batch), doubles(given, o + 8, batch)
    equal, pinned = integers(given, o + 9, batch), integers(given, o + 10, batch)
    guess_hard, guess_own = integers(given, o + 11, batch), integers(given, o + 12, batch)
    counts, level_of = integers(given, o + 13, o + 1)[0], integers(given, o + 14, o + 1)[0]
    place, most = integers(given, o + 15, o + 1)[0], integers(given, o + 16, o + 1)[0, 0]
    solution, multipliers = doubles(found, o, batch), doubles(found, o + 1, batch)
    reached, strengths = doubles(found, o + 2, batch), doubles(found, o + 3, batch)
    residual = doubles(found, o + 4, batch)
    box, sides, tight = integers(found, o + 5, batch), integers(found, o + 6, batch), integers(found, o + 7, batch)
    missed, own, ranks = integers(found, o + 8, batch), integers(found, o + 9, batch), integers(found, o + 10, batch)
    report = integers(found, o + 11, batch)
    F, J = workspace(s)
    copy(level_of, J[LEVEL_OF], h)
    for p in range(batch):  # not done: what an exception below leaves
        report[p, 0] = 0
    for p in range(batch):
        clear(multipliers[p], 0, L * h)
        for ints in (sides[p], tight[p], missed[p], own[p], ranks[p]):
            clear(ints, 0, len(ints))
        s.rank_tol, s.step_tol = shares[p, 0], shares[p, 1]
        s.multiplier_tol, s.feasible_tol = shares[p, 2], shares[p, 3]
        begin(F, J, s, hard[p], low[p], high[p], pinned[p])
        warm = how_many(guess_own[p], L * m) > 0
        done, worst = True, 0.0
        for k in range(L):
            reached[p, k], strengths[p, k] = inf, 0.0
            if s.first == n:
                continue
            s.level, s.rows, s.mixed = k, counts[k], 0
            s.unmet, s.demand = dampings[p, 3 * k + 1], dampings[p, 3 * k + 2]
            for q in range(n, h):
                s.mixed = 1 if level_of[q] == k else s.mixed
            at, hard_at = k * m, k * h
            begin_level(F, J, s, matrix[p, at * n :], lower[p, at:], upper[p, at:], equal[p, at:], dampings[p, 3 * k])
            optimal, factored = False, False
            if warm:
                optimal, factored = try_guess(F, J, s, guess_hard[p, hard_at:], guess_own[p, at:])
            if not optimal:
                optimal = primal_active_set(F, J, s, most, factored)
            done, worst = done and optimal, max(worst, s.residual)
            here = sides[p, hard_at:], tight[p, hard_at:], missed[p, at:], own[p, at:], multipliers[p, hard_at:]
            ranks[p, k] = freeze(F, J, s, place, *here)
            reached[p, k], strengths[p, k] = s.missed, s.damping
            narrow_box(F, J, s, bends[p, k * n :])
            cut_off(F, J, s)
        for i in range(n):
            at_bound = J[BOX, i]
            narrowed = F[LOW, i] > low[p, i] if at_bound < 0 else F[HIGH, i] < high[p, i]
            solution[p, i], box[p, i] = F[X, i], 0 if narrowed else at_bound
        residual[p, 0] = worst
        report[p, 0], report[p, 1], report[p, 2] = 1 if done else 0, s.changes, s.factorizations


def handle(frame):
    """What XLA calls."""
    if is_call(frame):
        solve_all(arguments(frame), results(frame))
    return 0
