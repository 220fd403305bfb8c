"""A hierarchy of least squares, level after level, on a CPU: the candidate that ``solvers/hqp`` certifies.

Level k minimises ``1/2 |dist(A x, [l, u])|^2 + 1/2 damping |x|^2`` over the minimisers of the levels above it, inside
the hard rows: the box and the rows of earlier levels that have inequalities. The method and the conditions by which a
level is judged are those of ``solvers/hqp`` (``_working_set_solve.py``, ``_primal_active_set.py``, ``_freeze.py``);
here one orthonormal basis goes through all levels (``_level_workspace.py``).
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from . import _level_workspace as ws
from ._frame import arguments, compiled, doubles, integers, is_call, lean, results, size
from ._level_damping import level_damping, narrow_box
from ._level_factors import factor_active_rows, factor_level_rows, freeze_columns, to_basis
from ._level_search import primal_active_set, try_guess
from ._level_solve import evaluate, sign_tolerance
from ._level_workspace import clear, clip, copy, hard_value, workspace
from ._vectors import dot


@lean
def begin(F, J, s, hard, lower, upper, equality):
    """Start at the box's point nearest to 0; the basis is that of the variables that are not pinned."""
    Z, hard_rows = F[s.Z : s.Z + s.h], F[s.hard : s.hard + s.h - s.n]
    h, n = s.h, s.n
    s.first_active, s.changes, s.factorizations = 0, 0, 0
    for q in range(h):
        clear(Z[q], 0, n)
        J[ws.ACTIVE, q], J[ws.FROZEN, q], F[ws.HARD_NORM, q] = 0, 0, 1.0
        F[ws.HARD_LOWER, q], F[ws.HARD_UPPER, q] = lower[q], upper[q]
    for i in range(n):
        F[ws.CURVATURE, i], F[ws.X, i] = 0.0, clip(0.0, lower[i], upper[i])
        pinned = 1 if equality[i] != 0 else 0
        J[ws.FROZEN, i], J[ws.ACTIVE_BOUND, i] = pinned, 2 * pinned
        s.first_active += pinned
    column = s.first_active
    for i in range(n):
        if J[ws.FROZEN, i] == 0:
            Z[i, column] = 1.0
            column += 1
    for q in range(n, h):
        row = hard_rows[q - n]
        for i in range(n):
            row[i] = hard[(q - n) * n + i]
        to_basis(F, J, s, s.first_active, row, Z[q])
        norm = sqrt(dot(row, row, 0, n))
        F[ws.HARD_NORM, q] = norm if norm > 0.0 else 1.0


@lean
def begin_level(F, J, s, rows, lower, upper, equality, constant):
    """Copy the level's numbers to the workspace and compute its damping."""
    A, n, total = F[s.A : s.A + s.rows], s.n, 0.0
    s.longest_square = 0.0
    for a in range(s.rows):
        nonzero, end = n, 0
        for i in range(n):
            A[a, i] = rows[a * n + i]
            if A[a, i] != 0.0:
                nonzero, end = min(nonzero, i), i + 1
        J[ws.NONZERO, a], J[ws.NONZERO_END, a] = nonzero, end
        F[ws.LOWER, a], F[ws.UPPER, a], J[ws.EQUALITY, a] = lower[a], upper[a], equality[a]
        square = dot(A[a], A[a], 0, n)
        F[ws.ROW_NORM, a] = sqrt(square)
        s.longest_square, total = max(s.longest_square, square), total + square
    s.size, s.frobenius = sqrt(s.longest_square), sqrt(total)
    s.damping = level_damping(F, J, s, constant)
    s.size = max(s.size, sqrt(s.damping))
    copy(F[ws.X], F[ws.START], n)


@lean
def freeze(F, J, s, row_of_hard, active, frozen, in_cost, own, multipliers):
    """Freeze what the level determines: active rows with a multiplier, and its own rows that miss their interval.

    Both have one value on the whole face of minimisers (docs/derivations.md, "The freezing rule"). A force that the
    damping explains does not freeze a row.

    Returns:
        The rank of the rows in the cost, for the derivative.
    """
    h, n = s.h, s.n
    evaluate(F, J, s)
    force_tol = sign_tolerance(s) + s.damping * sqrt(dot(F[ws.X], F[ws.X], 0, n))
    same_cost, all_freeze = True, True
    for a in range(s.rows):
        slack_tol = s.multiplier_tol * (F[ws.ROW_NORM, a] * s.x_max + s.root_cost)
        now = 1 if J[ws.EQUALITY, a] != 0 or abs(F[ws.SLACK, a]) > slack_tol else 0
        same_cost = same_cost and now == J[ws.IN_COST, a]
        J[ws.IN_COST, a] = now
        in_cost[a] = (1 if F[ws.SLACK, a] > 0.0 else -1) if now != 0 else 0
        own[a] = 2 if J[ws.EQUALITY, a] != 0 else in_cost[a]
    for q in range(h):
        force = abs(F[ws.MULTIPLIER, q]) * F[ws.HARD_NORM, q]
        J[ws.FREEZES, q] = J[ws.ACTIVE, q] != 0 and force > force_tol
        all_freeze = all_freeze and (J[ws.FREEZES, q] != 0) == (J[ws.ACTIVE, q] != 0)
        active[q], multipliers[q] = J[ws.ACTIVE, q], F[ws.MULTIPLIER, q]
    rank = s.rank
    # the level's own factors serve where they have just the rows that are frozen
    if not (same_cost and all_freeze):
        for q in range(h):
            J[ws.ACTIVE, q] = J[ws.ACTIVE, q] if J[ws.FREEZES, q] != 0 else 0
        factor_active_rows(F, J, s)
        factor_level_rows(F, J, s)
    tie = same_cost and s.rank != rank and s.damping == 0.0  # the rank is another without the rows of no multiplier
    for q in range(h):
        frozen[q] = active[q] if J[ws.FREEZES, q] != 0 or tie else 0
        if q < n:
            before = J[ws.ACTIVE_BOUND, q] if J[ws.FROZEN, q] != 0 else 0
            J[ws.ACTIVE_BOUND, q] = active[q] if active[q] != 0 else before
        elif J[ws.LEVEL_OF, q] == s.level:
            # the levels below may not make a row of this one worse than it is
            value = hard_value(F, J, s, q, F[ws.X])
            F[ws.HARD_LOWER, q], F[ws.HARD_UPPER, q] = min(F[ws.HARD_LOWER, q], value), max(F[ws.HARD_UPPER, q], value)
            J[ws.FROZEN, q] = J[ws.FROZEN, q] != 0 or J[ws.IN_COST, row_of_hard[q - n]] != 0
        J[ws.FROZEN, q] = J[ws.FROZEN, q] != 0 or J[ws.FREEZES, q] != 0
        J[ws.ACTIVE, q] = 0 if J[ws.FREEZES, q] != 0 else active[q]
    return rank if tie else s.rank


@lean
def count_nonzero(a, stop):
    """Return how many of the first integers are not 0."""
    count = 0
    for j in range(stop):
        count += a[j] != 0
    return count


@compiled
def solve_all(given, found):
    """Solve all problems of a batch; arguments and results, a row a problem, are those of ``solvers/hqp/_numba.py``."""
    batch, L = size(given, 0, 0), size(given, 0, 1)
    s = np.zeros(1, ws.SCALARS)[0]
    s.m, s.n, s.h = size(given, 0, 2), size(given, 0, 3), size(given, 4, 1)
    m, n, h = s.m, s.n, s.h
    o = batch - batch  # numbers of buffers that are no part of a type: one `doubles` is compiled, not one for each
    matrix, lower, upper = doubles(given, o, batch), doubles(given, o + 1, batch), doubles(given, o + 2, batch)
    hard, hard_lower, hard_upper = (
        doubles(given, o + 3, batch),
        doubles(given, o + 4, batch),
        doubles(given, o + 5, batch),
    )
    dampings, bends, tolerances = (
        doubles(given, o + 6, batch),
        doubles(given, o + 7, batch),
        doubles(given, o + 8, batch),
    )
    equality, pinned = integers(given, o + 9, batch), integers(given, o + 10, batch)
    guess_hard, guess_own = integers(given, o + 11, batch), integers(given, o + 12, batch)
    row_counts, level_of_hard = integers(given, o + 13, o + 1)[0], integers(given, o + 14, o + 1)[0]
    row_of_hard, max_iterations = integers(given, o + 15, o + 1)[0], integers(given, o + 16, o + 1)[0, 0]
    solution, multipliers = doubles(found, o, batch), doubles(found, o + 1, batch)
    slack_norms, damping = doubles(found, o + 2, batch), doubles(found, o + 3, batch)
    residual = doubles(found, o + 4, batch)
    active_bounds, active = integers(found, o + 5, batch), integers(found, o + 6, batch)
    frozen, in_cost = integers(found, o + 7, batch), integers(found, o + 8, batch)
    own, ranks, report = integers(found, o + 9, batch), integers(found, o + 10, batch), integers(found, o + 11, batch)
    F, J = workspace(s)
    copy(level_of_hard, J[ws.LEVEL_OF], h)
    for p in range(batch):  # not done: what an exception below leaves
        report[p, 0] = 0
    for p in range(batch):
        clear(multipliers[p], 0, L * h)
        for ints in (active[p], frozen[p], in_cost[p], own[p], ranks[p]):
            clear(ints, 0, len(ints))
        s.rank_tol, s.step_tol = tolerances[p, 0], tolerances[p, 1]
        s.multiplier_tol, s.feasible_tol = tolerances[p, 2], tolerances[p, 3]
        begin(F, J, s, hard[p], hard_lower[p], hard_upper[p], pinned[p])
        warm = count_nonzero(guess_own[p], L * m) > 0
        done, worst = True, 0.0
        for k in range(L):
            slack_norms[p, k], damping[p, k] = inf, 0.0
            if s.first_active == n:
                continue
            s.level, s.rows, s.has_inequalities = k, row_counts[k], 0
            s.unmet, s.demand = dampings[p, 3 * k + 1], dampings[p, 3 * k + 2]
            for q in range(n, h):
                s.has_inequalities = 1 if level_of_hard[q] == k else s.has_inequalities
            # rows of this level, and its hard rows, in results that have all levels in a row
            at, hard_at = k * m, k * h
            level = matrix[p, at * n :], lower[p, at:], upper[p, at:], equality[p, at:], dampings[p, 3 * k]
            begin_level(F, J, s, *level)
            optimal, factored = False, False
            if warm:
                optimal, factored = try_guess(F, J, s, guess_hard[p, hard_at:], guess_own[p, at:])
            if not optimal:
                optimal = primal_active_set(F, J, s, max_iterations, factored)
            done, worst = done and optimal, max(worst, s.residual)
            here = active[p, hard_at:], frozen[p, hard_at:], in_cost[p, at:], own[p, at:], multipliers[p, hard_at:]
            ranks[p, k] = freeze(F, J, s, row_of_hard, *here)
            slack_norms[p, k], damping[p, k] = s.slack_norm, s.damping
            narrow_box(F, J, s, bends[p, k * n :])
            freeze_columns(F, J, s)
        for i in range(n):
            # a bound that levels narrowed for those below them is none of the box
            at_bound = J[ws.ACTIVE_BOUND, i]
            if at_bound < 0:
                narrowed = F[ws.HARD_LOWER, i] > hard_lower[p, i]
            else:
                narrowed = F[ws.HARD_UPPER, i] < hard_upper[p, i]
            solution[p, i], active_bounds[p, i] = F[ws.X, i], 0 if narrowed else at_bound
        residual[p, 0] = worst
        report[p, 0], report[p, 1], report[p, 2] = 1 if done else 0, s.changes, s.factorizations


def handle(frame):
    """Answer XLA's call with the solutions of the batch, and its question for the version of the interface."""
    if is_call(frame):
        solve_all(arguments(frame), results(frame))
    return 0
