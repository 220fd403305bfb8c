"""Space of the null space's kernels for one problem, in rows of whole blocks of eight numbers.

What is behind the last number of a row may be anything, except where a field says that there are 0s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ._frame import compiled, matrix, vector
from ._sizes import row_space_numbers
from ._tiles import padded
from ._vectors import WIDTH


class Work(NamedTuple):
    """Space for one problem; M rows of the longest level, w the larger of n and M.

    Fields, each number of rows and columns filled up:
        turned: orthonormal rows, of which those taken come first. (n, n)
        beside: the level's rows in these coordinates, a column each. (n, w)
        across: the transpose of ``turned``, from the first row that is left on. (n, n)
        rows, columns: minus the level's rows, and their transpose, with 0s behind them. (w, n), (n, w)
        less: minus a Gram matrix, of rows or of columns. (w, w)
        symmetric, upper, lower: what is factored, and its factors. (w, w)
        turns, turns_by_coordinate: reflections of one level, a row (and a block more) or a column each. (n, n), (n, n)
        along: what they take from ``turned``. (n, n)
        basis_columns, triangle: the factorisation of a level that is nearly dependent. (n, w + n), (n, n)
        turn: a reflection.
        products: what it takes from each column of ``beside``; its products with others.
        zeros: 0s.
        value, wanted, size: of the level's rows: what they are, what they ask for, their squared length.
        square: of what is left of them in the coordinates that are left.
        inverse, diagonal: of the factors.
        solved, missing, right: unknowns, residuals, right-hand sides.
        motion: what the level asks for.
        low, high, bent: the box of the levels below, and the curvature of those above. (n,)
    """

    turned: np.ndarray
    beside: np.ndarray
    across: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    less: np.ndarray
    symmetric: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    turns: np.ndarray
    turns_by_coordinate: np.ndarray
    along: np.ndarray
    basis_columns: np.ndarray
    triangle: np.ndarray
    turn: np.ndarray
    products: np.ndarray
    zeros: np.ndarray
    value: np.ndarray
    wanted: np.ndarray
    size: np.ndarray
    square: np.ndarray
    inverse: np.ndarray
    diagonal: np.ndarray
    solved: np.ndarray
    missing: np.ndarray
    right: np.ndarray
    motion: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bent: np.ndarray


work_size = compiled(row_space_numbers)


@compiled
def work_at(space, n, M):
    """Return the space for one problem, in the numbers at an address; rows, columns and vectors become 0s."""
    tall, wide = padded(n) + WIDTH, padded(n)
    w = padded(max(n, M))
    side = w + WIDTH
    numbers, each, line = vector(space, work_size(n, M)), 8 * side * side, 8 * side
    for i in range(3 * side * side, 5 * side * side):  # ``rows``, ``columns``
        numbers[i] = 0.0
    for i in range(15 * side * side, len(numbers)):  # vectors
        numbers[i] = 0.0
    at = space + 15 * each
    return Work(
        matrix(space, tall, wide), matrix(space + each, tall, w), matrix(space + 2 * each, wide, wide),
        matrix(space + 3 * each, w, wide), matrix(space + 4 * each, wide, w), matrix(space + 5 * each, w, w),
        matrix(space + 6 * each, w, w), matrix(space + 7 * each, w, w), matrix(space + 8 * each, w, w),
        matrix(space + 9 * each, wide, tall), matrix(space + 10 * each, wide, wide),
        matrix(space + 11 * each, wide, wide), matrix(space + 12 * each, wide, w + wide),
        matrix(space + 14 * each, wide, wide), vector(at, side), vector(at + line, side), vector(at + 2 * line, side),
        vector(at + 3 * line, side), vector(at + 4 * line, side), vector(at + 5 * line, side),
        vector(at + 6 * line, side), vector(at + 7 * line, side), vector(at + 8 * line, side),
        vector(at + 9 * line, side), vector(at + 10 * line, side), vector(at + 11 * line, 2 * side),
        vector(at + 13 * line, side), vector(at + 14 * line, n), vector(at + 15 * line, n), vector(at + 16 * line, n),
    )  # fmt: skip
