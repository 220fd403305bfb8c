"""A hierarchy of least squares, level after level, on a CPU: the candidate that ``solvers/hqp`` certifies.

Level k minimises ``1/2 |dist(A x, [l, u])|^2 + 1/2 damping |x|^2`` over the minimisers of the levels above it, inside the
hard rows: the box and the rows of earlier levels that hold inequalities. What is solved, and how a level is judged, is
that of ``solvers/hqp/_cascade.py``, ``_primal.py`` and ``_landing.py``; here with one orthonormal basis for all of it.

``Z`` has that basis in its columns, in three groups:

    [0, first)     what the levels above have decided: x does not move along these any more
    [first, open)  spanned by the active rows, the hard rows that this level holds at a bound
    [open, n)      free: the level's rows are factored within these columns

A Householder reflection from the right turns columns among each other, so that a row gets all its length into one
column. A row of ``Z`` for each hard row, ``N_q Z``, makes box and general rows one thing.
"""

from __future__ import annotations

from math import inf, isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import int64

from ..._damping import BENDS, LEAST, PASSES, ROOM, SPENT
from ._frame import arguments, compiled, doubles, integers, is_call, results, size

_ATTEMPTS = 4  # at a working-set guess, before the primal active set takes over
_PATIENCE = 20  # steps of no length, before the least index decides
_WEAK = 1e-9  # of the longest row, squared: the damping of a step along directions that the factor left out
_RIDGE = 1e-14  # of the longest row, squared: keeps the damped factor positive
_DEMAND_RIDGE = 1e-13  # of the rows' squares: the same, where a level's damping is found

_SCALARS = np.dtype(
    [(name, np.int64) for name in ("level", "rows", "first", "open", "rank", "changes", "factorizations", "mixed")]
    + [
        (name, np.float64)
        for name in ("size", "longest", "frobenius", "damping", "unmet", "demand", "reach", "missed", "missing", "steepness")
        + ("residual", "rank_tol", "step_tol", "multiplier_tol", "feasible_tol")
    ],
    align=True,
)


class Work(NamedTuple):
    """Arrays of one problem: n variables, h hard rows (the box, then others), M rows of the longest level."""

    Z: Any  # the basis, and beside the variables' rows those of the other hard rows (h, n)
    A: Any  # the level's rows (M, n)
    R: Any  # their triangular factor, rows in the columns of Z (M, n)
    V: Any  # its reflections from the left, one a row (M, M)
    S: Any  # a square matrix above and on the diagonal, its Cholesky factor below (M, M)
    hard: Any  # hard rows beside the box (h - n, n)
    x: Any
    start: Any  # where the level above ended
    step: Any
    turn: Any  # a reflection, or coordinates in the basis
    pull: Any  # downhill, in the basis
    bent: Any  # how much a variable bends the rows of the levels so far
    low: Any  # of the hard rows, and so the following
    high: Any
    length: Any
    multiplier: Any
    below: Any  # of the level's rows, and so the following
    above: Any
    norm: Any
    value: Any
    slack: Any
    rate: Any
    right: Any
    scale: Any  # of the reflections
    inverse: Any  # of the Cholesky factor's diagonal
    side: Any  # of the hard rows: -1 active at the lower bound, 1 at the upper; and so the following
    carried: Any
    frozen: Any
    waits: Any
    tight: Any
    level_of: Any
    equal: Any  # of the level's rows, and so the following
    counts: Any  # in the level's cost
    own: Any  # how they count: -1 below their interval, 1 above, 2 an equality, 0 inside
    pivot: Any
    box: Any
    held: Any  # the hard row that column first + k is for


@compiled
def workspace(n, h, M):
    """Arrays of these sizes; one column or row at least, so that none is empty."""
    m, p = max(M, 1), max(h - n, 1)
    ints = np.zeros((9, max(h, M, 1)), np.int32)
    return Work(
        np.zeros((h, n)), np.zeros((m, n)), np.zeros((m, n)), np.zeros((m, m)), np.zeros((m, m)), np.zeros((p, n)),
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros(h), np.zeros(h), np.zeros(h), np.zeros(h),
        np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m),
        np.zeros(m),
        ints[0], ints[1], ints[2], ints[3], ints[4], ints[5],
        ints[6], ints[7], ints[8], np.zeros(m, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32),
    )  # fmt: skip


@compiled(fastmath={"reassoc", "contract"})
def dot(a, b, start, stop):
    """``sum_j a_j b_j`` over some columns."""
    total = 0.0
    for j in range(start, stop):
        total += a[j] * b[j]
    return total


@compiled
def add(a, by, b, start, stop):
    """``a += by b`` in some columns."""
    for j in range(start, stop):
        a[j] += by * b[j]


@compiled
def clip(a, low, high):
    """The nearest point of an interval."""
    return min(max(a, low), high)


@compiled
def reflection(row, at, n, turn):
    """The vector v of ``I - scale v v'``, which takes a row's columns from ``at`` on into that column; and its scale."""
    norm = sqrt(dot(row, row, at, n))
    for j in range(at, n):
        turn[j] = row[j]
    head = row[at]
    turn[at] = head + (-norm if head < 0.0 else norm)
    return 1.0 / (norm * (norm + abs(head)))


@compiled
def reflect(rows, first_row, stop_row, turn, scale, at, n):
    """Some rows times ``I - scale v v'``."""
    for q in range(first_row, stop_row):
        row = rows[q]
        by = scale * dot(row, turn, at, n)
        if by != 0.0:
            add(row, -by, turn, at, n)


@compiled
def from_basis(w, s, start, stop, out):
    """``out = Z turn``, over some columns."""
    for i in range(out.shape[0]):
        out[i] = dot(w.Z[i], w.turn, start, stop)


@compiled
def to_basis(w, start, a, out):
    """``out = Z' a``, in the columns from ``start`` on."""
    n = w.x.shape[0]
    out[start:] = 0.0
    for i in range(n):
        if a[i] != 0.0:
            add(out, a[i], w.Z[i], start, n)


@compiled
def hard_value(w, q, d):
    """Hard row q times d."""
    n = w.x.shape[0]
    return d[q] if q < n else dot(w.hard[q - n], d, 0, n)


@compiled
def cholesky(w, count, ridge):
    """``L L' = S + ridge I``; L goes below the diagonal of S, the inverse of its diagonal to ``inverse``."""
    S = w.S
    for k in range(count):
        pivot = S[k, k] + ridge - dot(S[k], S[k], 0, k)
        w.inverse[k] = 1.0 / sqrt(max(pivot, 1e-300))
        for a in range(k + 1, count):
            S[a, k] = (S[k, a] - dot(S[a], S[k], 0, k)) * w.inverse[k]


@compiled
def cholesky_solve(w, count, y):
    """``y <- (L L')^-1 y``."""
    for k in range(count):
        y[k] = (y[k] - dot(w.S[k], y, 0, k)) * w.inverse[k]
    for k in range(count - 1, -1, -1):
        y[k] *= w.inverse[k]
        add(y, -y[k], w.S[k], 0, k)


@compiled
def gram(w, count, start):
    """Above and on the diagonal of S, ``R R'`` over the columns from ``start`` on; its trace."""
    n, trace = w.x.shape[0], 0.0
    for a in range(count):
        for b in range(a, count):
            w.S[a, b] = dot(w.R[a], w.R[b], start, n)
        trace += w.S[a, a]
    return trace


@compiled
def project(w, s, start):
    """``R = A Z`` for the rows that count (0 for the others), in the columns from ``start`` on."""
    n = w.x.shape[0]
    for a in range(s.rows):
        row = w.R[a]
        row[start:] = 0.0
        if w.counts[a] != 0:
            for i in range(n):
                if w.A[a, i] != 0.0:
                    add(row, w.A[a, i], w.Z[i], start, n)


@compiled
def hold(w, s):
    """Rotates the active hard rows into the columns [first, open); rows that depend on others are let go.

    The one that stands farthest out of those before it comes first (pivoted QR of ``N_q Z / |N_q|``).
    """
    h, n = w.Z.shape
    w.waits[:h] = w.side[:h] != 0
    s.open = s.first
    while s.open < n:
        best, which = -1.0, int64(-1)
        for q in range(h):
            if w.waits[q] != 0:
                far = dot(w.Z[q], w.Z[q], s.open, n) / w.length[q] ** 2
                if far > best:
                    best, which = far, q
        if not best > s.rank_tol**2:
            break
        scale = reflection(w.Z[which], s.open, n, w.turn)
        reflect(w.Z, 0, h, w.turn, scale, s.open, n)
        w.waits[which] = 0
        w.held[s.open - s.first] = which
        s.open += 1
    for q in range(h):
        if w.waits[q] != 0:
            w.side[q] = 0


@compiled
def fit(w, s):
    """Factors the rows that count within the free columns: ``Q' (A Z) = R`` by reflections with column pivoting.

    Pivots under the rank tolerance end it. With damping, ``R R' + damping I`` is factored too.
    """
    n, m, R = w.x.shape[0], s.rows, w.R
    s.factorizations += 1
    project(w, s, s.open)
    s.rank = 0
    while s.rank < min(n - s.open, m):
        k = s.rank
        w.turn[s.open :] = 0.0  # squares of the columns, from row k down
        for a in range(k, m):
            for j in range(s.open, n):
                w.turn[j] += R[a, j] * R[a, j]
        best, which = -1.0, int64(-1)
        for j in range(s.open, n):
            if w.turn[j] > best:
                best, which = w.turn[j], j
        norm = sqrt(max(best, 0.0))
        if not norm > s.rank_tol * s.size:
            break
        v, head = w.V[k], R[k, which]
        for a in range(m):
            v[a] = R[a, which] if a > k else 0.0
        v[k] = head + (-norm if head < 0.0 else norm)
        w.scale[k], w.pivot[k] = 1.0 / (norm * (norm + abs(head))), which
        w.turn[s.open :] = 0.0
        for a in range(k, m):
            add(w.turn, w.scale[k] * v[a], R[a], s.open, n)
        for a in range(k, m):
            add(R[a], -v[a], w.turn, s.open, n)
        for a in range(k + 1, m):
            R[a, which] = 0.0
        s.rank += 1
    if s.damping > 0.0:
        gram(w, s.rank, s.open)
        cholesky(w, s.rank, s.damping + _RIDGE * s.size**2)


@compiled
def least_squares(w, s):
    """The step d in the free columns that makes ``1/2 |slack + A d|^2 + 1/2 damping |x + d|^2`` least.

    Without damping, ``R d = -Q' slack`` in the pivots' columns. With it, ``x + d = R' y`` there, with
    ``(R R' + damping I) y = R x - Q' slack``.
    """
    n, m, y = w.x.shape[0], s.rows, w.right
    for a in range(m):
        y[a] = -w.slack[a] if w.counts[a] != 0 else 0.0
    for k in range(s.rank):
        add(y, -w.scale[k] * dot(w.V[k], y, k, m), w.V[k], k, m)
    if s.damping > 0.0:
        to_basis(w, s.open, w.x, w.pull)
        for k in range(s.rank):
            y[k] += dot(w.R[k], w.pull, s.open, n)
        cholesky_solve(w, s.rank, y)
        for j in range(s.open, n):
            w.turn[j] = -w.pull[j]
        for k in range(s.rank):
            add(w.turn, y[k], w.R[k], s.open, n)
    else:
        w.turn[s.open :] = 0.0
        for k in range(s.rank - 1, -1, -1):
            z = y[k] / w.R[k, w.pivot[k]]
            w.turn[w.pivot[k]] = z
            for b in range(k):
                y[b] -= w.R[b, w.pivot[k]] * z
    from_basis(w, s, s.open, n, w.step)


@compiled
def restore(w, s):
    """The shortest step that brings the active rows to their bounds: ``(N Z) t = bound - N x`` by substitution."""
    for k in range(s.open - s.first):
        q = w.held[k]
        gap = (w.low[q] if w.side[q] < 0 else w.high[q]) - hard_value(w, q, w.x)
        j = s.first + k
        w.turn[j] = (gap - dot(w.Z[q], w.turn, s.first, j)) / w.Z[q, j]
    from_basis(w, s, s.first, s.open, w.step)


@compiled
def judge(w, s):
    """Multipliers of the active rows, ``sum_q N_q multiplier_q = -gradient`` in their columns, and stationarity.

    ``pull = -Z' gradient``; what of it is left in the free columns is the residual.
    """
    n = w.x.shape[0]
    gradient = w.step
    for i in range(n):
        gradient[i] = s.damping * w.x[i]
    for a in range(s.rows):
        if w.counts[a] != 0:
            add(gradient, w.slack[a], w.A[a], 0, n)
    s.steepness = sqrt(dot(gradient, gradient, 0, n))
    to_basis(w, s.first, gradient, w.pull)
    s.residual = 0.0
    for j in range(s.first, n):
        w.pull[j] = -w.pull[j]
        if j >= s.open:
            s.residual = max(s.residual, abs(w.pull[j]))
        w.turn[j] = w.pull[j]
    w.multiplier[:] = 0.0
    for k in range(s.open - s.first - 1, -1, -1):
        q, j = w.held[k], s.first + k
        w.multiplier[q] = w.turn[j] / w.Z[q, j]
        add(w.turn, -w.multiplier[q], w.Z[q], s.first, j)


@compiled
def look(w, s):
    """Values and slacks of the level at x, their norm, and the root of twice its cost."""
    n = w.x.shape[0]
    s.reach = np.max(np.abs(w.x))
    square = 0.0
    for a in range(s.rows):
        w.value[a] = dot(w.A[a], w.x, 0, n)
        near = w.below[a] if w.equal[a] != 0 else clip(w.value[a], w.below[a], w.above[a])
        w.slack[a] = w.value[a] - near
        square += w.slack[a] ** 2
    s.missed = sqrt(square)
    s.missing = sqrt(square + s.damping * dot(w.x, w.x, 0, n))


@compiled
def roundoff(s):
    """Slopes of the level's cost under this are roundoff."""
    return s.size * s.step_tol * (s.size * s.reach + s.missing)


@compiled
def sign_tolerance(s):
    """A multiplier has the wrong sign where it is wrong by more than this."""
    return s.multiplier_tol * s.steepness + roundoff(s)


@compiled
def is_stationary(s):
    """Whether what is left of the gradient in the free columns is roundoff."""
    return s.residual <= 10.0 * (s.multiplier_tol * s.size * s.missing + roundoff(s))


@compiled
def may_block(w, s, q):
    """Whether a hard row can stop this level: not frozen, and of the box or of a level above."""
    return w.frozen[q] == 0 and w.level_of[q] < s.level


@compiled
def level_damping(w, s, constant):
    """``constant + unmet share``, share the part of the demand that the step with this very damping misses.

    The fixed point of ``solvers/_damping.py:effective``; 0 where its slopes would be roundoff.
    """
    n, m, least = w.x.shape[0], s.rows, LEAST * s.longest
    damping = constant
    if s.unmet > least:
        share, before = 1.0, 0.0
        to_basis(w, s.first, w.x, w.turn)
        from_basis(w, s, s.first, n, w.step)
        base, end = w.start, w.step
        for i in range(n):
            base[i] = w.x[i] - w.step[i]
        for a in range(m):
            at = dot(w.A[a], base, 0, n)
            w.rate[a] = (w.below[a] if w.equal[a] != 0 else clip(at, w.below[a], w.above[a])) - at  # the goal
            w.counts[a] = w.equal[a] != 0 or w.rate[a] != 0.0
        project(w, s, s.first)
        trace = gram(w, m, s.first)
        for _ in range(PASSES):
            if share == before or not s.unmet * share > least:
                break
            before = share
            ridge = constant + s.unmet * share + _DEMAND_RIDGE * trace
            cholesky(w, m, ridge if ridge > 0.0 else 1.0)
            w.right[:m] = w.rate[:m]
            cholesky_solve(w, m, w.right)
            w.turn[s.first :] = 0.0
            for a in range(m):
                add(w.turn, w.right[a], w.R[a], s.first, n)
            from_basis(w, s, s.first, n, end)
            for i in range(n):
                end[i] = clip(base[i] + end[i], w.low[i], w.high[i])
            square = 0.0
            for a in range(m):
                at = dot(w.A[a], end, 0, n)
                near = w.below[a] if w.equal[a] != 0 else clip(at, w.below[a], w.above[a])
                square += (at - near) ** 2
            share = min(sqrt(square) / (s.demand if s.demand > 0.0 else 1.0), 1.0)
        damping = constant + s.unmet * share
    return damping if damping > least else 0.0


@compiled
def usable(at, low, high):
    """The side of a working-set guess, 0 where its bound does not exist."""
    if at < 0 and isfinite(low):
        return -1
    return 1 if at > 0 and isfinite(high) else 0


@compiled
def solve_on_working_set(w, s):
    """The minimiser of the level with the active rows at their bounds and the rows that count as near as can be."""
    w.x[:] = w.start
    for a in range(s.rows):
        w.counts[a] = w.own[a] != 0
    hold(w, s)
    fit(w, s)
    for _ in range(2):  # once more against exact residuals
        restore(w, s)
        w.x[:] += w.step
        own_slack(w, s)
        least_squares(w, s)
        w.x[:] += w.step
    look(w, s)
    own_slack(w, s)
    s.missing = sqrt(dot(w.slack, w.slack, 0, s.rows) + s.damping * dot(w.x, w.x, 0, w.x.shape[0]))


@compiled
def own_slack(w, s):
    """Slacks of the rows that count, from the side that they count on."""
    for a in range(s.rows):
        goal = w.above[a] if w.own[a] == 1 else w.below[a]
        w.slack[a] = dot(w.A[a], w.x, 0, w.x.shape[0]) - goal if w.counts[a] != 0 else 0.0


@compiled
def improve_working_set(w, s):
    """Holds what is violated, releases what pulls, and lets rows count that miss their interval; all at once.

    Returns:
        Whether the point is feasible, whether the rows of the level count on the right sides, whether the signs of
        the multipliers are right, and how many changes were made.
    """
    feasible, consistent, signs, turned = True, True, True, 0
    tolerance = sign_tolerance(s)
    for q in range(w.low.shape[0]):
        if w.side[q] != 0:
            if -w.multiplier[q] * w.side[q] * w.length[q] > tolerance:
                w.side[q], signs, turned = 0, False, turned + 1
        elif may_block(w, s, q):
            at = hard_value(w, q, w.x)
            near = s.feasible_tol * (w.length[q] * s.reach + abs(at))
            if not max(w.low[q] - at, at - w.high[q]) <= near:
                w.side[q], feasible, turned = (-1 if at < w.low[q] else 1), False, turned + 1
    for a in range(s.rows):
        near = s.feasible_tol * (w.norm[a] * s.reach + abs(w.value[a]))
        under, over, own = w.below[a] - w.value[a], w.value[a] - w.above[a], w.own[a]
        right = own == 2 or (max(under, over) <= near if own == 0 else (under if own < 0 else over) >= -near)
        if not right:
            w.own[a] = 0 if own != 0 else (-1 if under > over else 1)
            consistent, turned = False, turned + 1
    return feasible, consistent, signs, turned


@compiled
def try_guess(w, s, guess_hard, guess_own):
    """The minimiser on a guessed working set; where it is not the optimum, on what it shows to be better, a few times.

    Where none is the optimum, the last one is the start of the primal active set if it is feasible, else the point
    where the level above ended. (M. Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a
    semismooth Newton method", 2003.)

    Returns:
        Whether it is the optimum, and whether the factors are those of the working set.
    """
    h = w.low.shape[0]
    w.carried[:h] = w.side[:h]
    for q in range(h):
        w.side[q] = usable(guess_hard[q], w.low[q], w.high[q]) if may_block(w, s, q) else 0
    for a in range(s.rows):
        w.own[a] = 2 if w.equal[a] != 0 else usable(guess_own[a], w.below[a], w.above[a])
    feasible = False
    for attempt in range(_ATTEMPTS):
        solve_on_working_set(w, s)
        if not isfinite(s.reach):
            feasible = False
            break
        judge(w, s)
        w.waits[:h] = w.side[:h]
        feasible, consistent, signs, turned = improve_working_set(w, s)
        if feasible and consistent and signs and is_stationary(s):
            return True, True
        if turned == 0 or attempt + 1 == _ATTEMPTS:
            w.side[:h] = w.waits[:h]
            break
        s.changes += turned
    if not feasible:
        w.x[:] = w.start
        w.side[:h] = w.carried[:h]
    return False, feasible


@compiled
def line_slope(w, s, t, along_x, along_d):
    """The derivative at t of the level's cost along ``x + t d``."""
    total = along_x + t * along_d
    for a in range(s.rows):
        at = w.value[a] + t * w.rate[a]
        near = w.below[a] if w.equal[a] != 0 else clip(at, w.below[a], w.above[a])
        total += w.rate[a] * (at - near)
    return total


@compiled
def line_search(w, s, along_x, along_d):
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
                bound = w.below[row] if a % 2 == 0 else w.above[row]
                if w.rate[row] != 0.0 and isfinite(bound):
                    knot = max((bound - w.value[row]) / w.rate[row], 0.0)
            if which == 0 and knot > before and line_slope(w, s, knot, along_x, along_d) < 0.0:
                before = knot
            if which == 1 and knot > before:
                after = min(after, knot)
    probe = 0.5 * (before + after) if isfinite(after) else before + 1.0
    at_first, at_last = line_slope(w, s, before, along_x, along_d), line_slope(w, s, probe, along_x, along_d)
    if at_last > at_first:
        return max(before - at_first * (probe - before) / (at_last - at_first), 0.0)
    return before


@compiled
def step_length(w, s):
    """How far the hard rows let the step go, and which of them stops it (the least index among equals)."""
    stride = sqrt(dot(w.step, w.step, 0, w.x.shape[0]))
    nearest, which, towards = inf, int64(-1), 0
    for q in range(w.low.shape[0]):
        if w.side[q] == 0 and may_block(w, s, q):
            rate = hard_value(w, q, w.step)
            if abs(rate) > s.rank_tol * stride * w.length[q]:
                bound = w.high[q] if rate > 0.0 else w.low[q]
                time = max((bound - hard_value(w, q, w.x)) / rate, 0.0)
                if time < nearest:
                    nearest, which, towards = time, q, (1 if rate > 0.0 else -1)
    return nearest, which, towards


@compiled
def most_wrong(w, s, least_index):
    """The active row whose multiplier has the wrong sign by most, or the first of these; -1 for none."""
    tolerance, worst, which = sign_tolerance(s), 0.0, int64(-1)
    for q in range(w.low.shape[0]):
        if w.side[q] != 0:
            wrong = -w.multiplier[q] * w.side[q] * w.length[q]
            if wrong > tolerance and wrong > worst and not (least_index and which >= 0):
                worst, which = wrong, q
    return which


@compiled
def primal_active_set(w, s, most, factored):
    """From a feasible point to the level's optimum, feasible all the way; whether it was found.

    Each iteration takes the least-squares step on the active rows to the first row that blocks it, which becomes
    active. Where the step vanishes, the row with the most wrongly signed multiplier is released; without one, the point
    is the optimum. Where it rests on a direction that the factor's tolerance left out, it takes one damped step there.
    """
    n = w.x.shape[0]
    stalled, tried, to_hold, to_fit = 0, False, not factored, not factored
    for _ in range(most):
        look(w, s)
        if to_hold:
            hold(w, s)
        turned = to_hold or to_fit
        for a in range(s.rows):
            now = 1 if w.equal[a] != 0 or w.slack[a] != 0.0 else 0
            turned = turned or now != w.counts[a]
            w.counts[a] = now
        if turned:
            fit(w, s)
        to_hold = to_fit = False
        least_squares(w, s)
        square = 0.0
        for a in range(s.rows):
            w.rate[a] = dot(w.A[a], w.step, 0, n)
            square += w.rate[a] ** 2 if w.counts[a] != 0 else 0.0
        along_x, along_d = s.damping * dot(w.x, w.step, 0, n), s.damping * dot(w.step, w.step, 0, n)
        weak = False
        if sqrt(square + along_d) <= s.step_tol * (s.size * s.reach + s.missing):
            judge(w, s)
            weak = not tried and not is_stationary(s)
            if not weak:
                which = most_wrong(w, s, stalled > _PATIENCE)
                if which < 0:
                    return True
                w.side[which] = 0
                to_hold = True
                s.changes += 1
                continue
            tried = True
            for j in range(s.open, n):
                w.turn[j] = w.pull[j] / (_WEAK * s.size**2 + s.damping)
            from_basis(w, s, s.open, n, w.step)
        limit, which, towards = step_length(w, s)
        ideal = line_search(w, s, along_x, along_d) if s.mixed != 0 and not weak else 1.0
        blocked = limit <= ideal
        share = limit if blocked else ideal
        moved = 0.0
        for i in range(n):
            moved = max(moved, share * abs(w.step[i]))
            w.x[i] += share * w.step[i]
        stalled = 0 if moved > 0.0 else stalled + 1
        if blocked:
            w.side[which] = towards
            s.changes += 1
            to_hold, tried = True, False
    return False


@compiled
def narrow_box(w, s, bends):
    """The box of the levels below: what they may spend of the progress of a level that is out of reach.

    ``room_below`` of ``solvers/_damping.py``: a motion d costs up to ``1/2 missed size sum_j bent_j d_j^2``.
    """
    n = w.x.shape[0]
    missed = min(s.missed, s.demand)
    share = missed / (s.demand if s.demand > 0.0 else 1.0)
    most, many = 0.0, 0
    for i in range(n):
        w.bent[i] = max(w.bent[i], bends[i] / (s.frobenius if s.frobenius > 0.0 else 1.0))
        most = max(most, missed * s.frobenius * w.bent[i])
    if not s.unmet * share > LEAST * s.longest:
        return
    for i in range(n):
        many += missed * s.frobenius * w.bent[i] > BENDS * most
    gain = SPENT * (s.demand - missed) * (s.demand + missed)
    for i in range(n):
        cost = missed * s.frobenius * w.bent[i]
        if cost > BENDS * most:
            room = sqrt(gain / (many * cost)) + ROOM
            w.low[i], w.high[i] = max(w.low[i], w.x[i] - room), min(w.high[i], w.x[i] + room)


@compiled
def freeze(w, s, hard_place, sides, tight, missed, own, multipliers):
    """What the level decides for those below: active rows that push, and its own rows that miss their interval.

    Both hold with the same values on the whole face of minimisers. A force that the damping explains does not count.

    Returns:
        The rank of the rows that count, for the decision.
    """
    h, n = w.Z.shape
    look(w, s)
    floor = sign_tolerance(s) + s.damping * sqrt(dot(w.x, w.x, 0, n))
    same, all_tight = True, True
    for a in range(s.rows):
        small = s.multiplier_tol * (w.norm[a] * s.reach + s.missing)
        now = 1 if w.equal[a] != 0 or abs(w.slack[a]) > small else 0
        same = same and now == w.counts[a]
        w.counts[a] = now
        missed[a] = (1 if w.slack[a] > 0.0 else -1) if now != 0 else 0
        own[a] = 2 if w.equal[a] != 0 else missed[a]
    for q in range(h):
        w.tight[q] = w.side[q] != 0 and abs(w.multiplier[q]) * w.length[q] > floor
        all_tight = all_tight and (w.tight[q] != 0) == (w.side[q] != 0)
        sides[q], multipliers[q] = w.side[q], w.multiplier[q]
    rank = s.rank
    if not (same and all_tight):
        for q in range(h):
            w.side[q] = w.side[q] if w.tight[q] != 0 else 0
        hold(w, s)
        fit(w, s)
    tie = same and s.rank != rank and s.damping == 0.0  # more would count without the rows that do not push
    for q in range(h):
        tight[q] = sides[q] if w.tight[q] != 0 or tie else 0
        if q < n:
            w.box[q] = sides[q] if sides[q] != 0 else (w.box[q] if w.frozen[q] != 0 else 0)
        elif w.level_of[q] == s.level:
            at = hard_value(w, q, w.x)
            w.low[q], w.high[q] = min(w.low[q], at), max(w.high[q], at)
            w.frozen[q] = w.frozen[q] != 0 or w.counts[hard_place[q - n]] != 0
        w.frozen[q] = w.frozen[q] != 0 or w.tight[q] != 0
        w.side[q] = 0 if w.tight[q] != 0 else sides[q]
    return rank if tie else s.rank


@compiled
def cut_off(w, s):
    """Takes what is decided out of the basis: the active rows' columns and the row space of the level's factor."""
    h, n = w.Z.shape
    for k in range(s.rank):
        at = s.open + k
        scale = reflection(w.R[k], at, n, w.turn)
        reflect(w.Z, 0, h, w.turn, scale, at, n)
        reflect(w.R, k + 1, s.rank, w.turn, scale, at, n)
    s.first = s.open + s.rank


@compiled
def begin_level(w, s, rows, lower, upper, equal, dampings):
    """The level's numbers to the workspace."""
    n = w.x.shape[0]
    s.longest = total = 0.0
    for a in range(s.rows):
        w.A[a] = rows[a]
        w.below[a], w.above[a], w.equal[a] = lower[a], upper[a], equal[a]
        square = dot(rows[a], rows[a], 0, n)
        w.norm[a] = sqrt(square)
        s.longest, total = max(s.longest, square), total + square
    s.size, s.frobenius = sqrt(s.longest), sqrt(total)
    s.unmet, s.demand = dampings[1], dampings[2]
    s.damping = level_damping(w, s, dampings[0])
    s.size = max(s.size, sqrt(s.damping))
    w.start[:] = w.x


@compiled
def begin(w, s, hard, low, high, equal, level_of):
    """The box's nearest point to 0, and a basis of what its pinned variables leave: columns of the identity."""
    h, n = w.Z.shape
    w.Z[:] = 0.0
    w.level_of[:h], w.low[:], w.high[:] = level_of, low, high
    w.side[:], w.bent[:], w.length[:] = 0, 0.0, 1.0
    s.first, s.changes, s.factorizations = 0, 0, 0
    for i in range(n):
        w.x[i] = clip(0.0, low[i], high[i])
        w.frozen[i] = equal[i] != 0
        w.box[i] = 2 if equal[i] != 0 else 0
        s.first += equal[i] != 0
    column = s.first
    for i in range(n):
        if equal[i] == 0:
            w.Z[i, column] = 1.0
            column += 1
    for q in range(n, h):
        w.hard[q - n] = hard[q - n]
        to_basis(w, s.first, hard[q - n], w.Z[q])
        norm = sqrt(dot(hard[q - n], hard[q - n], 0, n))
        w.length[q] = norm if norm > 0.0 else 1.0
        w.frozen[q] = 0


@compiled
def solve_all(given, found):
    """All problems of a batch; arguments and results are those of ``candidates`` in ``solvers/hqp/_numba.py``."""
    batch, L, M, n = size(given, 0, 0), size(given, 0, 1), size(given, 0, 2), size(given, 0, 3)
    h = size(given, 5, 1)
    matrix = doubles(given, 0, (batch, L, M, n))
    lower, upper = doubles(given, 1, (batch, L, M)), doubles(given, 2, (batch, L, M))
    equal, hard = integers(given, 3, (batch, L, M)), doubles(given, 4, (batch, h - n, n))
    hard_lower, hard_upper = doubles(given, 5, (batch, h)), doubles(given, 6, (batch, h))
    hard_equal, guess_hard = integers(given, 7, (batch, h)), integers(given, 8, (batch, L, h))
    guess_own, dampings = integers(given, 9, (batch, L, M)), doubles(given, 10, (batch, L, 3))
    bends, tolerances = doubles(given, 11, (batch, L, n)), doubles(given, 12, (batch, 4))
    counts, level_of = integers(given, 13, (L,)), integers(given, 14, (h,))
    hard_place, most = integers(given, 15, (h - n,)), integers(given, 16, (1,))[0]
    solution, box = doubles(found, 0, (batch, n)), integers(found, 1, (batch, n))
    sides, tight = integers(found, 2, (batch, L, h)), integers(found, 3, (batch, L, h))
    missed, own = integers(found, 4, (batch, L, M)), integers(found, 5, (batch, L, M))
    ranks, multipliers = integers(found, 6, (batch, L)), doubles(found, 7, (batch, L, h))
    reached, strengths = doubles(found, 8, (batch, L)), doubles(found, 9, (batch, L))
    residuals, report = doubles(found, 10, (batch,)), integers(found, 11, (batch, 3))
    report[:] = 0  # not done: what an exception below leaves
    sides[:], tight[:], missed[:], own[:], ranks[:] = 0, 0, 0, 0, 0
    multipliers[:], reached[:], strengths[:] = 0.0, inf, 0.0
    w, s = workspace(n, h, M), np.zeros(1, _SCALARS)[0]
    for p in range(batch):
        s.rank_tol, s.step_tol = tolerances[p, 0], tolerances[p, 1]
        s.multiplier_tol, s.feasible_tol = tolerances[p, 2], tolerances[p, 3]
        begin(w, s, hard[p], hard_lower[p], hard_upper[p], hard_equal[p], level_of)
        warm = np.any(guess_own[p] != 0)
        done, worst = True, 0.0
        for k in range(L):
            if s.first == n:
                break
            s.level, s.rows = k, counts[k]
            s.mixed = 1 if np.any(level_of == k) else 0
            begin_level(w, s, matrix[p, k], lower[p, k], upper[p, k], equal[p, k], dampings[p, k])
            optimal, factored = False, False
            if warm:
                optimal, factored = try_guess(w, s, guess_hard[p, k], guess_own[p, k])
            if not optimal:
                optimal = primal_active_set(w, s, most, factored)
            done, worst = done and optimal, max(worst, s.residual)
            ranks[p, k] = freeze(w, s, hard_place, sides[p, k], tight[p, k], missed[p, k], own[p, k], multipliers[p, k])
            reached[p, k], strengths[p, k] = s.missed, s.damping
            narrow_box(w, s, bends[p, k])
            cut_off(w, s)
        for i in range(n):
            at = w.box[i]
            narrowed = w.low[i] > hard_lower[p, i] if at < 0 else w.high[i] < hard_upper[p, i]
            solution[p, i], box[p, i] = w.x[i], 0 if narrowed else at
        residuals[p] = worst
        report[p, 0], report[p, 1], report[p, 2] = done, s.changes, s.factorizations


def handle(frame):
    """What XLA calls."""
    if is_call(frame):
        solve_all(arguments(frame), results(frame))
    return 0
