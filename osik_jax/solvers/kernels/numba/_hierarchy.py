"""A hierarchy of least squares, level after level, on a CPU: the candidate that ``solvers/hqp`` certifies.

Level k minimises ``1/2 |dist(A x, [l, u])|^2 + 1/2 damping |x|^2`` over the minimisers of the levels above it, inside
the hard rows: the box and the rows of earlier levels that hold inequalities. What is solved, and how a level is judged,
is that of ``_cascade.py``, ``_primal.py`` and ``_landing.py`` in ``solvers/hqp``; here with one orthonormal basis
(``_level_factors.py``).
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from ..._damping import BENDS, LEAST, PASSES, ROOM, SPENT
from ._frame import arguments, compiled, doubles, integers, is_call, lean, results, size
from ._level_factors import (
    ABOVE,
    BELOW,
    BENT,
    BOX,
    COUNTS,
    EQUAL,
    FROZEN,
    HIGH,
    LENGTH,
    LEVEL_OF,
    LOW,
    MULTIPLIER,
    NORM,
    RATE,
    RIGHT,
    SCALARS,
    SIDE,
    SINCE,
    SLACK,
    START,
    STEP,
    TIGHT,
    TURN,
    UNTIL,
    X,
    cholesky,
    cholesky_solve,
    clear,
    clip,
    copy,
    fit,
    from_basis,
    gram,
    hard_value,
    hold,
    look,
    project,
    reflect,
    reflection,
    sign_tolerance,
    to_basis,
    workspace,
)
from ._level_search import primal_active_set, try_guess
from ._vectors import add, dot

_DEMAND_RIDGE = 1e-13  # of the rows' squares: keeps dependent rows from breaking the factor, where a damping is found


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
    s.first = s.open + s.rank
    if s.first == n:  # nothing asks for the basis of nothing
        return
    for k in range(s.rank):
        at = s.open + k
        scale = reflection(R[k], at, n, F[TURN])
        reflect(Z, 0, h, F[TURN], scale, at, n)
        reflect(R, k + 1, s.rank, F[TURN], scale, at, n)


@lean
def begin_level(F, J, s, rows, lower, upper, equal, constant):
    """The level's numbers to the workspace."""
    A, n, total = F[s.A : s.A + s.rows], s.n, 0.0
    s.longest = 0.0
    for a in range(s.rows):
        since, until = n, 0
        for i in range(n):
            A[a, i] = rows[a * n + i]
            if A[a, i] != 0.0:
                since, until = min(since, i), i + 1
        J[SINCE, a], J[UNTIL, a] = since, until
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
    s = np.zeros(1, SCALARS)[0]
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
