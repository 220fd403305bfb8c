"""The working set of one level of a hierarchy: guessed and improved at once, or searched for a row at a time."""

from __future__ import annotations

from math import inf, isfinite, sqrt

from numba import int64

from ...numerics._constants import EXTRA_DAMPING, MAX_ATTEMPTS, MAX_STALLED
from . import _level_workspace as ws
from ._frame import lean
from ._level_factors import factor_active_rows, factor_level_rows, from_basis
from ._level_solve import (
    evaluate,
    is_stationary,
    least_squares_step,
    multipliers,
    sign_tolerance,
    solve_on_working_set,
)
from ._level_workspace import copy, hard_value, target
from ._vectors import dot


@lean
def may_block(F, J, s, q):
    """Check that a hard row can stop this level: not frozen, and of the box or of a level above."""
    return J[ws.FROZEN, q] == 0 and J[ws.LEVEL_OF, q] < s.level


@lean
def usable_side(side, lower, upper):
    """Return the sign of a guessed active side, 0 where its bound is infinite."""
    if side < 0 and isfinite(lower):
        return -1
    return 1 if side > 0 and isfinite(upper) else 0


@lean
def improve_working_set(F, J, s):
    """Activate violated rows, release those of wrong sign, put rows outside their interval in the cost; all at once.

    Returns:
        Whether the point is feasible, whether the rows in the cost are those outside their interval, whether the signs
        of the multipliers are right, and how many changes were made.
    """
    feasible, consistent, signs, changes = True, True, True, 0
    tolerance = sign_tolerance(s)
    for q in range(s.h):
        if J[ws.ACTIVE, q] != 0:
            if -F[ws.MULTIPLIER, q] * J[ws.ACTIVE, q] * F[ws.HARD_NORM, q] > tolerance:
                J[ws.ACTIVE, q], signs, changes = 0, False, changes + 1
        elif may_block(F, J, s, q):
            value = hard_value(F, J, s, q, F[ws.X])
            near = s.feasible_tol * (F[ws.HARD_NORM, q] * s.x_max + abs(value))
            if not max(F[ws.HARD_LOWER, q] - value, value - F[ws.HARD_UPPER, q]) <= near:
                side = -1 if value < F[ws.HARD_LOWER, q] else 1
                J[ws.ACTIVE, q], feasible, changes = side, False, changes + 1
    for a in range(s.rows):
        near = s.feasible_tol * (F[ws.ROW_NORM, a] * s.x_max + abs(F[ws.VALUE, a]))
        below, above, own = F[ws.LOWER, a] - F[ws.VALUE, a], F[ws.VALUE, a] - F[ws.UPPER, a], J[ws.OWN, a]
        # of a row that is not in the cost, no violation; of one that is, no place inside its interval
        right = own == 2 or (max(below, above) <= near if own == 0 else (below if own < 0 else above) >= -near)
        if not right:
            J[ws.OWN, a] = 0 if own != 0 else (-1 if below > above else 1)
            consistent, changes = False, changes + 1
    return feasible, consistent, signs, changes


@lean
def try_guess(F, J, s, guess_hard, guess_own):
    """Solve on a guessed working set and, where that is not optimal, a few times on the one it improves to.

    Where none is optimal, the last one is the start of the primal active-set method if it is feasible, else the point
    where the level above ended. (M. Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a
    semismooth Newton method", 2003.)

    Returns:
        Whether the point is optimal, and whether the factors are those of its working set.
    """
    h = s.h
    copy(J[ws.ACTIVE], J[ws.ACTIVE_ABOVE], h)
    for q in range(h):
        side = usable_side(guess_hard[q], F[ws.HARD_LOWER, q], F[ws.HARD_UPPER, q])
        J[ws.ACTIVE, q] = side if may_block(F, J, s, q) else 0
    for a in range(s.rows):
        side = usable_side(guess_own[a], F[ws.LOWER, a], F[ws.UPPER, a])
        J[ws.OWN, a] = 2 if J[ws.EQUALITY, a] != 0 else side
    feasible = False
    for attempt in range(MAX_ATTEMPTS):
        solve_on_working_set(F, J, s)
        if not isfinite(s.x_max):
            feasible = False
            break
        multipliers(F, J, s)
        copy(J[ws.ACTIVE], J[ws.PENDING], h)
        feasible, consistent, signs, changes = improve_working_set(F, J, s)
        if feasible and consistent and signs and is_stationary(s):
            return True, True
        # the factors are of the working set before the last improvement
        if changes == 0 or attempt + 1 == MAX_ATTEMPTS:
            copy(J[ws.PENDING], J[ws.ACTIVE], h)
            break
        s.changes += changes
    if not feasible:
        copy(F[ws.START], F[ws.X], s.n)
        copy(J[ws.ACTIVE_ABOVE], J[ws.ACTIVE], h)
    return False, feasible


@lean
def line_derivative(F, J, s, t, damping_x, damping_d):
    """Return the derivative at t of the level's cost along ``x + t d``: ``d' (A' slack + damping (x + t d))``."""
    total = damping_x + t * damping_d
    for a in range(s.rows):
        value = F[ws.VALUE, a] + t * F[ws.RATE, a]
        total += F[ws.RATE, a] * (value - target(F, J, a, value))
    return total


@lean
def line_search(F, J, s, damping_x, damping_d):
    """Return the t >= 0 that minimises the level's cost along ``x + t d``: convex, and quadratic between knots.

    Knots are where a row enters or leaves its interval. Between the last one with a negative derivative and the next,
    the derivative is a straight line.
    """
    before, after = 0.0, inf
    for which in range(2):  # first the last knot with a negative derivative, then the one after it
        for a in range(-1, 2 * s.rows):
            knot = 1.0
            if a >= 0:
                row = a // 2
                bound = F[ws.LOWER, row] if a % 2 == 0 else F[ws.UPPER, row]
                if F[ws.RATE, row] != 0.0 and isfinite(bound):
                    knot = max((bound - F[ws.VALUE, row]) / F[ws.RATE, row], 0.0)
            if which == 0 and knot > before and line_derivative(F, J, s, knot, damping_x, damping_d) < 0.0:
                before = knot
            if which == 1 and knot > before:
                after = min(after, knot)
    probe = 0.5 * (before + after) if isfinite(after) else before + 1.0
    first = line_derivative(F, J, s, before, damping_x, damping_d)
    second = line_derivative(F, J, s, probe, damping_x, damping_d)
    # the secant through two points of the straight line has its root
    if second > first:
        return max(before - first * (probe - before) / (second - first), 0.0)
    return before


@lean
def ratio_test(F, J, s):
    """Return the step length to the first hard row that blocks, which one (least index among equals), and its side."""
    step_norm = sqrt(dot(F[ws.STEP], F[ws.STEP], 0, s.n))
    shortest, which, side = inf, int64(-1), 0
    for q in range(s.h):
        if J[ws.ACTIVE, q] == 0 and may_block(F, J, s, q):
            rate = hard_value(F, J, s, q, F[ws.STEP])
            # under the rank tolerance the row depends on active rows
            if abs(rate) > s.rank_tol * step_norm * F[ws.HARD_NORM, q]:
                bound = F[ws.HARD_UPPER, q] if rate > 0.0 else F[ws.HARD_LOWER, q]
                ratio = max((bound - hard_value(F, J, s, q, F[ws.X])) / rate, 0.0)
                if ratio < shortest:
                    shortest, which, side = ratio, q, (1 if rate > 0.0 else -1)
    return shortest, which, side


@lean
def most_wrong_sign(F, J, s, least_index):
    """Return the active row whose multiplier has the wrong sign by most, or the first of these; -1 for none."""
    tolerance, worst, which = sign_tolerance(s), 0.0, int64(-1)
    for q in range(s.h):
        if J[ws.ACTIVE, q] != 0:
            wrong = -F[ws.MULTIPLIER, q] * J[ws.ACTIVE, q] * F[ws.HARD_NORM, q]
            if wrong > tolerance and wrong > worst and not (least_index and which >= 0):
                worst, which = wrong, q
    return which


@lean
def primal_active_set(F, J, s, max_iterations, factored):
    """Search the level's optimum from a feasible point, feasible all the way; return whether it was found.

    Each iteration takes the least-squares step on the active rows to the first row that blocks it, which becomes
    active. Where the step vanishes, the row with the most wrongly signed multiplier is released; without one, the point
    is the optimum. Where it rests on a direction that the factor's tolerance left out, it takes one damped step there.
    """
    A = F[s.A : s.A + s.rows]
    n = s.n
    stalled, weak_tried, active_changed, unfactored = 0, False, not factored, not factored
    for _ in range(max_iterations):
        evaluate(F, J, s)
        if active_changed:
            factor_active_rows(F, J, s)
        to_factor = active_changed or unfactored
        for a in range(s.rows):
            in_cost = 1 if J[ws.EQUALITY, a] != 0 or F[ws.SLACK, a] != 0.0 else 0
            to_factor = to_factor or in_cost != J[ws.IN_COST, a]
            J[ws.IN_COST, a] = in_cost
        if to_factor:
            factor_level_rows(F, J, s)
        active_changed = unfactored = False
        least_squares_step(F, J, s)
        square = 0.0
        for a in range(s.rows):
            F[ws.RATE, a] = dot(A[a], F[ws.STEP], 0, n)
            square += F[ws.RATE, a] ** 2 if J[ws.IN_COST, a] != 0 else 0.0
        damping_x = s.damping * dot(F[ws.X], F[ws.STEP], 0, n)
        damping_d = s.damping * dot(F[ws.STEP], F[ws.STEP], 0, n)
        weak = False
        if sqrt(square + damping_d) <= s.step_tol * (s.size * s.x_max + s.root_cost):
            # the step changes the rows by no more than roundoff
            multipliers(F, J, s)
            weak = not weak_tried and not is_stationary(s)
            if not weak:
                which = most_wrong_sign(F, J, s, stalled > MAX_STALLED)
                if which < 0:
                    return True
                J[ws.ACTIVE, which] = 0
                active_changed = True
                s.changes += 1
                continue
            weak_tried = True
            for j in range(s.first_free, n):
                F[ws.WORK, j] = F[ws.DOWNHILL, j] / (EXTRA_DAMPING * s.size**2 + s.damping)
            from_basis(F, J, s, s.first_free, n, F[ws.STEP])
        longest, which, side = ratio_test(F, J, s)
        ideal = line_search(F, J, s, damping_x, damping_d) if s.has_inequalities != 0 and not weak else 1.0
        blocked = longest <= ideal
        length = longest if blocked else ideal
        moved = 0.0
        for i in range(n):
            moved = max(moved, length * abs(F[ws.STEP, i]))
            F[ws.X, i] += length * F[ws.STEP, i]
        stalled = 0 if moved > 0.0 else stalled + 1
        if blocked:
            J[ws.ACTIVE, which] = side
            s.changes += 1
            active_changed, weak_tried = True, False
    return False
