"""The row space of a level in the coordinates that are left, and the motion that the level asks for.

Householder reflections turn the coordinates: at once the level's rows in them, and all together what the coordinates
are made of (as in R. Schreiber, C. Van Loan, "A storage-efficient WY representation for products of Householder
transformations", SIAM J. Sci. Stat. Comput. 10, 1989). A level whose rows are independent takes its motion from their
Gram matrix, corrected once by what the rows themselves say; one that asks for all coordinates that are left turns
none of them. How far from dependent rows are is bounded by the determinant of that matrix: the product of all but the
least of its eigenvalues is at most their mean to that power. Where that is not far enough, orthogonal factors of
the rows with the root of the damping below them give the motion (modified Gram-Schmidt with the right-hand side as a
column: A. Bjorck, "Solving linear least squares problems by Gram-Schmidt orthogonalization", BIT 7, 1967).
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import INDEPENDENT_ROWS
from ._dense import add_multiple, dot, fill
from ._frame import lean
from ._padded_rows import add_to_rows, clear, minus_rows, plus_rows, plus_squares, put, put_multiple
from ._symmetric import factor_symmetric, solve_symmetric
from ._tiles import padded, take_product
from ._transpose import transpose


@lean
def set_beside(W, m, n, first, plain):
    """The level's rows in the coordinates that are left; ``plain`` where these are the variables."""
    if plain:
        for j in range(n):
            put_multiple(W.beside[j], -1.0, W.columns[j], padded(m))
        return
    for j in range(first, n):
        clear(W.beside[j], m)
    transpose(W.across, W.turned[first:], n - first, n)
    take_product(W.beside[first:], W.across, W.columns, 0, n - first, 0, padded(m), 0, n)


@lean
def set_gram(W, B, m, many):
    """``less`` is minus the Gram matrix of m columns of B, over ``many`` of its rows."""
    wide = padded(m)
    for i in range(wide):
        clear(W.less[i], m)
    take_product(W.less, B, B, 0, m, 0, wide, 0, many)
    for i in range(m):
        for k in range(m, wide):
            W.less[i, k] = 0.0


@lean
def factor_damped(W, m, damping):
    """Factor the Gram matrix with the damping on its diagonal, ones for what is nothing; whether it is positive."""
    wide = padded(m)
    for i in range(m):
        put_multiple(W.symmetric[i], -1.0, W.less[i], wide)
        W.symmetric[i, i] = W.symmetric[i, i] + damping if W.symmetric[i, i] + damping != 0.0 else 1.0
    for i in range(m, wide):
        clear(W.symmetric[i], m)
    return factor_symmetric(W.symmetric, W.lower, W.upper, W.inverse, W.diagonal, m, 0.0)


@lean
def reflect(W, m, n, first, at, pivot, length, plain):
    """The reflection that leaves of a column its head: of ``beside`` at once, of the coordinates it is written down."""
    k, head = at - first, W.turn[at]
    W.turn[at] = head + (length if head >= 0.0 else -length)
    scale = 1.0 / (length * (length + abs(head)))
    plus_rows(W.products, W.zeros, W.turn, W.beside, at, n, 0, m)
    put_multiple(W.products, -scale, W.products, padded(m))
    add_to_rows(W.beside, W.turn, W.products, at, n, 0, m)
    plus_squares(W.square, W.zeros, W.turn, W.beside, at + 1, n, 0, m)
    row = W.along[k]
    if plain:
        for j in range(at):
            row[j] = 0.0
        for j in range(at, n):
            row[j] = W.turn[j]
    else:
        plus_rows(row, W.zeros, W.turn, W.turned, at, n, 0, n)
    if k > 0:
        plus_rows(W.products, W.zeros, W.turn, W.turns_by_coordinate, at, n, 0, k)
        minus_rows(row, row, W.products, W.along, 0, k, 0, n)
    put_multiple(row, scale, row, padded(n))
    turns = W.turns[k]
    for j in range(first):
        turns[j] = 0.0
    for j in range(first, at):
        turns[j], W.turns_by_coordinate[j, k] = 0.0, 0.0
    for j in range(at, n):
        turns[j], W.turns_by_coordinate[j, k] = W.turn[j], W.turn[j]
    for j in range(n, len(turns)):
        turns[j] = 0.0


@lean(inline="always")
def take_row_space(W, m, n, first, cutoff, plain):
    """Turns the coordinates that are left so that the first ones span the level's rows; how many these are.

    The longest row that is left is the pivot, the first of equals; one no longer than the cutoff ends it. ``right`` has
    the squares of their lengths.
    """
    plus_squares(W.square, W.zeros, W.turn, W.beside, first, n, 0, m)
    at = first
    while at < n and at - first < m:
        pivot = np.int64(0)
        for i in range(1, m):
            pivot = i if W.square[i] > W.square[pivot] else pivot
        square = 0.0
        for j in range(at, n):
            W.turn[j] = W.beside[j, pivot]
            square += W.turn[j] * W.turn[j]
        length = np.sqrt(square)
        if not length > cutoff:
            break
        W.right[at - first] = square
        reflect(W, m, n, first, at, pivot, length, plain)
        at += 1
    if at > first:
        take_product(W.turned, W.turns, W.along, first, n, 0, padded(n), 0, at - first)
    return at - first


@lean
def solve_on_basis(W, m, n, first, rank, damping):
    """``right`` becomes y of least |C y - wanted|^2 + damping |y|^2, C the level's rows on the basis of their space."""
    root = np.sqrt(damping)
    for k in range(rank):
        column, row = W.basis_columns[k], W.beside[first + k]
        for i in range(m):
            column[i] = row[i]
        for i in range(m, m + rank):
            column[i] = 0.0
        column[m + k] = root
    fill(W.right, 0.0)
    for i in range(m):
        W.right[i] = W.wanted[i]
    for k in range(rank):
        column, stop = W.basis_columns[k], m + k + 1
        size = np.sqrt(dot(column, column, 0, stop))
        for i in range(stop):
            column[i] /= size
        W.triangle[k, k] = size
        for a in range(k + 1, rank):
            W.triangle[k, a] = dot(column, W.basis_columns[a], 0, stop)
            add_multiple(W.basis_columns[a], -W.triangle[k, a], column, stop)
        coefficient = dot(column, W.right, 0, stop)
        add_multiple(W.right, -coefficient, column, stop)
        W.solved[k] = coefficient
    for k in range(rank - 1, -1, -1):
        W.right[k] = (W.solved[k] - dot(W.triangle[k], W.right, k + 1, rank)) / W.triangle[k, k]


@lean
def are_independent(W, m, rank):
    """Whether the rows that are not nothing are as many as the rank, and far from dependent on each other."""
    many, trace = 0, 0.0
    for i in range(m):
        many, trace = many + (W.less[i, i] != 0.0), trace - W.less[i, i]
    if many != rank or rank == 0:
        return False
    mean, product = trace / max(rank - 1, 1), 1.0
    for k in range(rank):
        product *= W.right[k] / mean
    return product * mean >= INDEPENDENT_ROWS * trace


@lean
def solve_by_rows(W, m, first, rank, damping):
    """Likewise ``right``, from rows that are independent: C' (C C' + damping)^-1 wanted, corrected once."""
    if not factor_damped(W, m, damping):
        return False
    put(W.solved, W.zeros, m)
    put(W.missing, W.wanted, m)
    for again in range(2):
        solve_symmetric(W.lower, W.upper, W.inverse, W.missing, m)
        for i in range(m):
            W.solved[i] += W.missing[i]
        for k in range(rank):
            W.right[k] = dot(W.beside[first + k], W.solved, 0, m)
        if again == 0:
            minus_rows(W.missing, W.wanted, W.right, W.beside[first:], 0, rank, 0, m)
            for i in range(m):
                W.missing[i] -= damping * W.solved[i]
    return True


@lean
def solve_in_all(W, m, n, first, damping, cutoff):
    """Likewise ``right`` in all coordinates that are left, or False where the level may not determine all of them."""
    left, C = n - first, W.beside[first:]
    transpose(W.rows, C, left, m)
    set_gram(W, W.rows, left, m)
    for j in range(left):
        if not W.less[j, j] < 0.0:  # the rows have nothing of this coordinate
            return False
    if not factor_damped(W, left, damping):
        return False
    trace, product = 0.0, 1.0
    for j in range(left):
        trace += W.diagonal[j]
    mean = trace / max(left - 1, 1)
    for j in range(left):
        product /= W.inverse[j] * mean
    least = product * mean
    if not (least >= INDEPENDENT_ROWS * trace and least - damping > 2.0 * m * cutoff * cutoff):
        return False
    plus_rows(W.right, W.zeros, W.wanted, W.rows, 0, m, 0, left)
    solve_symmetric(W.lower, W.upper, W.inverse, W.right, left)
    minus_rows(W.missing, W.wanted, W.right, C, 0, left, 0, m)
    plus_rows(W.solved, W.zeros, W.missing, W.rows, 0, m, 0, left)
    for j in range(left):
        W.solved[j] -= damping * W.right[j]
    solve_symmetric(W.lower, W.upper, W.inverse, W.solved, left)
    for j in range(left):
        W.right[j] += W.solved[j]
    return True
