"""The working set of one level of a hierarchy: guessed and improved at once, or searched for a row at a time."""

from __future__ import annotations

from math import inf, isfinite, sqrt

from numba import int64

from ._frame import lean
from ._level_factors import (
    ABOVE,
    BELOW,
    CARRIED,
    COUNTS,
    EQUAL,
    FROZEN,
    HIGH,
    LENGTH,
    LEVEL_OF,
    LOW,
    MULTIPLIER,
    NORM,
    OWN,
    PULL,
    RATE,
    SIDE,
    SLACK,
    START,
    STEP,
    TURN,
    VALUE,
    WAITS,
    X,
    clip,
    copy,
    fit,
    from_basis,
    hard_value,
    hold,
    is_stationary,
    judge,
    least_squares,
    look,
    restore,
    sign_tolerance,
)
from ._vectors import add, dot

_ATTEMPTS = 4  # at a working-set guess, before the primal active set takes over
_PATIENCE = 20  # steps of no length, before the least index decides
_WEAK = 1e-9  # of the longest row, squared: the damping of a step along directions that the factor left out


@lean
def may_block(F, J, s, q):
    """Whether a hard row can stop this level: not frozen, and of the box or of a level above."""
    return J[FROZEN, q] == 0 and J[LEVEL_OF, q] < s.level


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
