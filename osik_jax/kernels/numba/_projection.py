"""Kernel of ``solvers/null_space/_projection.py``: all levels of one problem after another, in coordinates.

What is computed is what that file says. P_k is Z Z' with orthonormal columns Z, of which each level takes as many away
as it has rank, so that what is left gets smaller from level to level. ``turned`` has all of them in its rows, those
taken first; ``beside`` has the level's rows in these coordinates. Householder reflections, pivoted by the longest of
the level's rows that is left, turn both (``_row_space.py``): the rows of ``turned`` that a level has taken are then the
basis of the row space of A P, and those of ``beside`` the level's rows on it.

``level_damping`` and ``narrow`` are ``level_damping`` and ``narrow_box`` of ``solvers/_damping.py``; x is where P x = 0
before every level.
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
from ._dense import add_multiple, dot, fill
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._padded_rows import clear, minus_rows, plus_rows, plus_squares, put_multiple
from ._row_space import (
    are_independent,
    set_beside,
    set_gram,
    solve_by_rows,
    solve_in_all,
    solve_on_basis,
    take_row_space,
)
from ._row_space_workspace import work_at
from ._symmetric import factor_symmetric, solve_symmetric
from ._tiles import padded
from ._transpose import transpose


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


@lean
def gap(level, i, value):
    """Return how far it is from a value of row i to the nearest point of its interval."""
    if level.equal[i] != 0:
        return level.lower[i] - value
    return min(max(value, level.lower[i]), level.upper[i]) - value


@lean
def load(W, level):
    """Put the level's rows into rows of whole blocks, and into columns; minus them, so that products are taken off."""
    m, n = level.A.shape
    for i in range(m):
        put_multiple(W.rows[i], -1.0, level.A[i], n)
    for i in range(m, padded(m)):
        clear(W.rows[i], n)
    transpose(W.columns, W.rows, m, n)
    plus_squares(W.size, W.zeros, W.turn, W.columns, 0, n, 0, m)


@lean
def look(W, level, x):
    """Return what the level's rows are at x and ask for; the square of the longest row, and the size of all."""
    m, n = level.A.shape
    longest, size = 0.0, 0.0
    minus_rows(W.value, W.zeros, x, W.columns, 0, n, 0, m)
    for i in range(m):
        W.wanted[i] = gap(level, i, W.value[i])
        longest, size = max(longest, W.size[i]), size + W.size[i]
    return longest, np.sqrt(size)


@lean
def counts(W, level, i):
    """Whether row i takes part: an equality, or violated."""
    return level.equal[i] != 0 or W.wanted[i] != 0.0


@lean(inline="always")
def level_damping(W, level, first, longest):
    """Return the level's damping, constant + unmet ratio: the ratio of what the step with this very damping misses."""
    m, n = level.A.shape
    whole = level.constant
    if level.unmet != 0.0:
        set_gram(W, W.beside[first:], m, n - first)
        trace = 0.0
        for i in range(m):
            trace -= W.less[i, i] if counts(W, level, i) else 0.0
        ratio = 1.0
        for _ in range(DAMPING_ITERATIONS):
            damping = level.constant + level.unmet * ratio + DAMPING_RIDGE * trace
            ratio = min(missed_with(W, level, damping) / (level.demand if level.demand > 0.0 else 1.0), 1.0)
        whole += level.unmet * ratio
    return whole if whole > NEGLIGIBLE_DAMPING * longest else 0.0


@lean
def missed_with(W, level, damping):
    """Return the residual's size that the step with this damping leaves; rows that do not count are 0 in the step."""
    m = len(level.A)
    for i in range(m):
        put_multiple(W.symmetric[i], -1.0, W.less[i], padded(m))
        W.symmetric[i, i] += damping if damping > 0.0 else 1.0
        W.solved[i] = W.wanted[i]
    for i in range(m, padded(m)):
        clear(W.symmetric[i], m)
    for i in range(m):
        if not counts(W, level, i):
            for k in range(m):
                W.symmetric[i, k], W.symmetric[k, i] = 0.0, 0.0
            W.symmetric[i, i] = 1.0
    if not factor_symmetric(W.symmetric, W.lower, W.upper, W.inverse, W.diagonal, m, 0.0):
        return 0.0
    solve_symmetric(W.lower, W.upper, W.inverse, W.solved, m)
    minus_rows(W.missing, W.value, W.solved, W.less, 0, m, 0, m)
    missed = 0.0
    for i in range(m):
        missed += gap(level, i, W.missing[i]) ** 2
    return np.sqrt(missed)


@lean(inline="always")
def find_motion(W, level, first, damping, rank_tolerance, plain):
    """Find what the level asks for, and take its row space off the coordinates that are left; return the rank."""
    m, n = level.A.shape
    square, many = 0.0, 0
    for i in range(m):
        if counts(W, level, i):
            square, many = square + W.size[i], many + 1
        else:
            for j in range(first, n):
                W.beside[j, i] = 0.0
    cutoff = rank_tolerance * np.sqrt(square)
    if many >= n - first and solve_in_all(W, m, n, first, damping, cutoff):
        rank = n - first
    else:
        if many < m or level.unmet == 0.0 or many >= n - first:
            set_gram(W, W.beside[first:], m, n - first)
        rank = take_row_space(W, m, n, first, cutoff, plain)
        if not (are_independent(W, m, rank) and solve_by_rows(W, m, first, rank, damping)):
            solve_on_basis(W, m, n, first, rank, damping)
    plus_rows(W.motion, W.zeros, W.right, W.turned[first:], 0, rank, 0, n)
    return rank


@lean
def move(W, x):
    """Add as much of the motion to x as stays within what levels out of reach leave to those below."""
    part, n = 1.0, len(x)
    for i in range(n):
        step = W.motion[i]
        if step != 0.0:
            room = W.high[i] - x[i] if step > 0.0 else x[i] - W.low[i]
            if room < np.inf:
                part = min(part, room / abs(step))
    add_multiple(x, part, W.motion, n)


@lean
def narrow(W, level, x, longest, size):
    """Narrow the box of the levels below to what they may spend of the progress of a level that is out of reach."""
    m, n = level.A.shape
    for j in range(n):
        W.bent[j] = max(W.bent[j], level.bends[j] / (size if size > 0.0 else 1.0))
    if not level.unmet > NEGLIGIBLE_DAMPING * longest:
        return
    minus_rows(W.missing, W.zeros, x, W.columns, 0, n, 0, m)
    missed = 0.0
    for i in range(m):
        missed += gap(level, i, W.missing[i]) ** 2
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


@lean(inline="always")
def solve_level(W, level, x, first, rank_tolerance):
    """Moves x as the level asks; the rank that it takes."""
    m, n = level.A.shape
    load(W, level)
    longest, size = look(W, level, x)
    set_beside(W, m, n, first, first == 0)
    damping = level_damping(W, level, first, longest)
    rank = find_motion(W, level, first, damping, rank_tolerance, first == 0)
    move(W, x)
    narrow(W, level, x, longest, size)
    return rank


@lean
def end(W, x, secondary, first, projector):
    """Add the secondary motion in what is left, and make the projector onto that."""
    n = len(x)
    fill(projector.reshape(-1), 0.0)
    fill(W.motion, 0.0)
    for j in range(first, n):
        row = W.turned[j]
        add_multiple(W.motion, dot(row, secondary, 0, n), row, n)
        for i in range(n):
            add_multiple(projector[i], row[i], row, n)
    move(W, x)


def handle(frame):
    """Answer a call of XLA: arguments as in ``solvers/null_space/_dispatch.py``, a leading axis of lanes on each."""
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
        x, taken = vector(solution + 8 * n * lane, n), np.int64(0)  # no literal, which is a type of its own
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
