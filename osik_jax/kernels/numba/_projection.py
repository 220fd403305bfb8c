"""Kernel of ``solvers/null_space/_projection.py``: all levels of one problem after another, in coordinates.

What is computed is what that file says. P_k is Z Z' with orthonormal columns Z, of which each level takes as many away
as it has rank, so that what is left gets smaller from level to level. ``Q`` has all of them in its rows, those taken
first; beside them, in the same rows, the rows of the level in these coordinates: [Q | Q A']. Householder reflections
from the left, pivoted by the longest of the level's rows that is left, turn both at once: the rows of Q that a level
has taken are then the basis of the row space of A P, and the rows beside them the level's rows on it.

The motion comes from an orthogonal factorisation of those with the root of the damping below them (modified
Gram-Schmidt with the right-hand side as a column: A. Bjorck, "Solving linear least squares problems by Gram-Schmidt
orthogonalization", BIT 7, 1967). ``strength_of`` and ``narrow`` are ``level_damping`` and ``narrow_box`` of
``solvers/_damping.py``; x is where P x = 0 before every level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...numerics._constants import (
    COST_FRACTION,
    DAMPING_ITERATIONS,
    DAMPING_RIDGE,
    MIN_RADIUS,
    NEGLIGIBLE_CURVATURE,
    NEGLIGIBLE_DAMPING,
)
from ._dense import add_multiple, backward, cholesky, dot, fill, forward
from ._frame import arguments, compiled, data, dimension, is_call, lean, matrix, results, vector, whole_numbers


class Level(NamedTuple):
    """One level, weights multiplied in: ``A`` (m, n), ``lower``, ``upper``, ``equal`` (m,), its damping."""

    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    equal: np.ndarray
    constant: float
    unmet: float
    demand: float
    bends: np.ndarray


class Work(NamedTuple):
    """Space for one problem; M rows of the longest level, r = min(M, n).

    Fields: ``turned`` (n, n + M) as above. ``gram``, ``factor`` (M, M). ``columns`` (r, M + r) and ``triangle`` (r, r):
    the factorisation for the motion. ``turn`` (n,) a reflection, ``along`` (n + M,) what it takes from each column.
    ``value``, ``wanted``, ``solved``, ``square`` (M,) of the level's rows; ``right`` (M + r,). ``motion``, ``low``,
    ``high``, ``bent`` (n,).
    """

    turned: np.ndarray
    gram: np.ndarray
    factor: np.ndarray
    columns: np.ndarray
    triangle: np.ndarray
    turn: np.ndarray
    along: np.ndarray
    value: np.ndarray
    wanted: np.ndarray
    solved: np.ndarray
    square: np.ndarray
    right: np.ndarray
    motion: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bent: np.ndarray


@lean
def gap(level, i, value):
    """From a value of row i to the nearest point of its interval."""
    if level.equal[i] != 0:
        return level.lower[i] - value
    return min(max(value, level.lower[i]), level.upper[i]) - value


@lean
def look(W, level, x):
    """What the level's rows are at x and ask for; the square of the longest row, and the size of all."""
    m, n = level.A.shape
    longest, size = 0.0, 0.0
    for i in range(m):
        row = level.A[i]
        W.value[i] = dot(row, x, 0, n)
        W.wanted[i] = gap(level, i, W.value[i])
        square = dot(row, row, 0, n)
        longest, size = max(longest, square), size + square
    return longest, np.sqrt(size)


@lean
def set_beside(W, level, first, plain):
    """The level's rows in the coordinates that are left, beside Q; ``plain`` where Q is the identity."""
    m, n = level.A.shape
    for i in range(m):
        row = level.A[i]
        if plain:
            for j in range(n):
                W.turned[j, n + i] = row[j]
        else:
            for j in range(first, n):
                W.turned[j, n + i] = dot(row, W.turned[j], 0, n)


@lean
def counts(W, level, i):
    """Whether row i takes part: an equality, or violated."""
    return level.equal[i] != 0 or W.wanted[i] != 0.0


@lean
def strength_of(W, level, first, longest):
    """The damping of the level: constant + unmet share, share what the step with this very damping misses."""
    m, n = level.A.shape
    whole = level.constant
    if level.unmet != 0.0:
        for i in range(m):
            fill(W.gram[i], 0.0)
        for j in range(first, n):
            row = W.turned[j, n:]
            for i in range(m):
                add_multiple(W.gram[i], row[i], row, m)
        trace = 0.0
        for i in range(m):
            trace += W.gram[i, i] if counts(W, level, i) else 0.0
        share = 1.0
        for _ in range(DAMPING_ITERATIONS):
            strength = level.constant + level.unmet * share + DAMPING_RIDGE * trace
            share = min(missed_with(W, level, strength) / (level.demand if level.demand > 0.0 else 1.0), 1.0)
        whole += level.unmet * share
    return whole if whole > NEGLIGIBLE_DAMPING * longest else 0.0


@lean
def missed_with(W, level, strength):
    """Size of the residual that the step with this damping leaves; rows that do not count are 0 in the step."""
    m = len(level.A)
    for i in range(m):
        here = counts(W, level, i)
        for k in range(i):
            W.factor[i, k] = W.gram[i, k] if here and counts(W, level, k) else 0.0
        W.factor[i, i] = (W.gram[i, i] if here else 0.0) + (strength if strength > 0.0 else 1.0)
        W.solved[i] = W.wanted[i] if here else 0.0
    if not cholesky(W.factor, m, 0.0):
        return 0.0
    forward(W.factor, W.solved, m)
    backward(W.factor, W.solved, m)
    missed = 0.0
    for i in range(m):
        missed += gap(level, i, W.value[i] + dot(W.gram[i], W.solved, 0, m)) ** 2
    return np.sqrt(missed)


@lean
def take_row_space(W, m, n, first, cutoff):
    """Turns the coordinates that are left so that the first ones span the level's rows; how many these are.

    The longest row that is left is the pivot, the first of equals; one no longer than the cutoff ends it.
    """
    width = n + m
    fill(W.square, 0.0)
    for j in range(first, n):
        row = W.turned[j, n:]
        for i in range(m):
            W.square[i] += row[i] * row[i]
    at = first
    while at < n and at - first < m:
        pivot = 0
        for i in range(1, m):
            pivot = i if W.square[i] > W.square[pivot] else pivot
        length = 0.0
        for j in range(at, n):
            W.turn[j] = W.turned[j, n + pivot]
            length += W.turn[j] * W.turn[j]
        length = np.sqrt(length)
        if not length > cutoff:
            break
        head = W.turn[at]
        W.turn[at] = head + (length if head >= 0.0 else -length)
        scale = 1.0 / (length * (length + abs(head)))
        fill(W.along, 0.0)
        for j in range(at, n):
            add_multiple(W.along, W.turn[j], W.turned[j], width)
        fill(W.square, 0.0)
        for j in range(at, n):
            add_multiple(W.turned[j], -scale * W.turn[j], W.along, width)
            if j > at:
                row = W.turned[j, n:]
                for i in range(m):
                    W.square[i] += row[i] * row[i]
        at += 1
    return at - first


@lean
def solve_on_basis(W, m, n, first, rank, damping):
    """``right`` becomes y of least |C y - wanted|^2 + damping |y|^2, C the level's rows on the basis of their space."""
    root = np.sqrt(damping)
    for k in range(rank):
        column, row = W.columns[k], W.turned[first + k, n:]
        for i in range(m):
            column[i] = row[i]
        for i in range(m, m + rank):
            column[i] = 0.0
        column[m + k] = root
    fill(W.right, 0.0)
    for i in range(m):
        W.right[i] = W.wanted[i]
    for k in range(rank):
        column, stop = W.columns[k], m + k + 1
        size = np.sqrt(dot(column, column, 0, stop))
        for i in range(stop):
            column[i] /= size
        W.triangle[k, k] = size
        for a in range(k + 1, rank):
            W.triangle[k, a] = dot(column, W.columns[a], 0, stop)
            add_multiple(W.columns[a], -W.triangle[k, a], column, stop)
        share = dot(column, W.right, 0, stop)
        add_multiple(W.right, -share, column, stop)
        W.solved[k] = share
    for k in range(rank - 1, -1, -1):
        W.right[k] = (W.solved[k] - dot(W.triangle[k], W.right, k + 1, rank)) / W.triangle[k, k]


@lean
def find_motion(W, level, first, damping, rank_tolerance):
    """What the level asks for; takes its row space off the coordinates that are left, the rank that is returned."""
    m, n = level.A.shape
    square = 0.0
    for i in range(m):
        if counts(W, level, i):
            square += dot(level.A[i], level.A[i], 0, n)
        else:
            for j in range(first, n):
                W.turned[j, n + i] = 0.0
    rank = take_row_space(W, m, n, first, rank_tolerance * np.sqrt(square))
    solve_on_basis(W, m, n, first, rank, damping)
    fill(W.motion, 0.0)
    for k in range(rank):
        add_multiple(W.motion, W.right[k], W.turned[first + k], n)
    return rank


@lean
def move(W, x):
    """Adds as much of the motion to x as stays within what levels out of reach leave to those below."""
    part, n = 1.0, len(x)
    for i in range(n):
        way = W.motion[i]
        if way != 0.0:
            room = W.high[i] - x[i] if way > 0.0 else x[i] - W.low[i]
            if room < np.inf:
                part = min(part, room / abs(way))
    add_multiple(x, part, W.motion, n)


@lean
def narrow(W, level, x, longest, size):
    """The box of the levels below: what they may spend of the progress of a level that is out of reach."""
    m, n = level.A.shape
    for j in range(n):
        W.bent[j] = max(W.bent[j], level.bends[j] / (size if size > 0.0 else 1.0))
    if not level.unmet > NEGLIGIBLE_DAMPING * longest:
        return
    missed = 0.0
    for i in range(m):
        missed += gap(level, i, dot(level.A[i], x, 0, n)) ** 2
    missed = min(np.sqrt(missed), level.demand)
    if not level.unmet * (missed / (level.demand if level.demand > 0.0 else 1.0)) > NEGLIGIBLE_DAMPING * longest:
        return
    most, many = 0.0, 0
    for j in range(n):
        most = max(most, missed * size * W.bent[j])
    for j in range(n):
        many += missed * size * W.bent[j] > NEGLIGIBLE_CURVATURE * most
    gain = COST_FRACTION * (level.demand - missed) * (level.demand + missed)
    for j in range(n):
        cost = missed * size * W.bent[j]
        if cost > NEGLIGIBLE_CURVATURE * most:
            square = gain / (many * cost)
            room = (np.sqrt(square) if square > 0.0 else 0.0) + MIN_RADIUS
            W.low[j], W.high[j] = max(W.low[j], x[j] - room), min(W.high[j], x[j] + room)


@lean
def solve_level(W, level, x, first, rank_tolerance):
    """Moves x as the level asks; the rank that it takes."""
    longest, size = look(W, level, x)
    set_beside(W, level, first, first == 0)
    damping = strength_of(W, level, first, longest)
    rank = find_motion(W, level, first, damping, rank_tolerance)
    move(W, x)
    narrow(W, level, x, longest, size)
    return rank


@lean
def end(W, x, secondary, first, projector):
    """The secondary motion in what is left, and the projector onto that."""
    n = len(x)
    fill(projector.reshape(-1), 0.0)
    fill(W.motion, 0.0)
    for j in range(first, n):
        row = W.turned[j]
        add_multiple(W.motion, dot(row, secondary, 0, n), row, n)
        for i in range(n):
            add_multiple(projector[i], row[i], row, n)
    move(W, x)


@compiled
def work_at(space, n, M):
    """The space for one problem, in the numbers at an address: ``(n + 11) (n + M) + 2 M^2 + r (M + 2 r)``."""
    r = min(M, n)
    turned, at = matrix(space, n, n + M), space + 8 * n * (n + M)
    gram, at = matrix(at, M, M), at + 8 * M * M
    factor, at = matrix(at, M, M), at + 8 * M * M
    columns, at = matrix(at, r, M + r), at + 8 * r * (M + r)
    triangle, at = matrix(at, r, r), at + 8 * r * r
    line = 8 * (n + M)
    return Work(
        turned, gram, factor, columns, triangle, vector(at, n), vector(at + line, n + M), vector(at + 2 * line, M),
        vector(at + 3 * line, M), vector(at + 4 * line, M), vector(at + 5 * line, M), vector(at + 6 * line, M + r),
        vector(at + 7 * line, n), vector(at + 8 * line, n), vector(at + 9 * line, n), vector(at + 10 * line, n),
    )  # fmt: skip


def handle(frame):
    """One call of XLA: arguments as in ``solvers/null_space/_dispatch.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, n, levels = dimension(given, 0), dimension(given, 8), dimension(given + 8, 8)
    secondary, constant, unmet = data(given), data(given + 8), data(given + 16)
    demand, bends, rank = data(given + 24), data(given + 32), data(given + 40)
    solution, projector, space = data(found), data(found + 8), data(found + 16)
    first_level, each = given + 48, 32
    M = 0
    for k in range(levels):
        M = max(M, dimension(first_level + each * k, 8))
    W = work_at(space, n, M)
    for lane in range(lanes):
        x, taken = vector(solution + 8 * n * lane, n), 0
        fill(x, 0.0)
        fill(W.bent, 0.0)
        fill(W.low, -np.inf)
        fill(W.high, np.inf)
        for j in range(n):
            fill(W.turned[j], 0.0)
            W.turned[j, j] = 1.0
        for k in range(levels):
            here = first_level + each * k
            m = dimension(here, 8)
            if taken == n:
                continue
            level = Level(
                matrix(data(here) + 8 * m * n * lane, m, n), vector(data(here + 8) + 8 * m * lane, m),
                vector(data(here + 16) + 8 * m * lane, m), whole_numbers(data(here + 24) + 4 * m * lane, m),
                matrix(constant, lanes, levels)[lane, k], matrix(unmet, lanes, levels)[lane, k],
                matrix(demand, lanes, levels)[lane, k], vector(bends + 8 * n * (levels * lane + k), n),
            )  # fmt: skip
            taken += solve_level(W, level, x, taken, vector(rank, lanes)[lane])
        end(
            W, x, vector(secondary + 8 * n * lane, n), taken, matrix(projector + 8 * n * n * lane, n, n),
        )  # fmt: skip
    return 0
