"""Kernel of ``solvers/_row_factors.py``: pivoted Gram-Schmidt of the rows, and of their columns on the new basis.

What is computed is what that file says, pivot after pivot; here each lane stops at its own rank.
"""

from __future__ import annotations

import numpy as np

from ._dense import add_multiple, dot, fill
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector


@lean
def longest(rest, n):
    """Return the number of the longest row, the first of equals."""
    most, which = -1.0, 0
    for i in range(len(rest)):
        square = dot(rest[i], rest[i], 0, n)
        if square > most:
            most, which = square, i
    return which


@lean
def next_direction(rest, basis, k, cutoff):
    """Make the longest row that is left, orthogonalised again, the k-th of the basis; return whether it counts."""
    n = rest.shape[1]
    row, direction = rest[longest(rest, n)], basis[k]
    for j in range(n):
        direction[j] = row[j]
    for a in range(k):
        add_multiple(direction, -dot(basis[a], row, 0, n), basis[a], n)
    length = np.sqrt(dot(direction, direction, 0, n))
    if not length > cutoff:
        fill(direction, 0.0)
        return False
    for j in range(n):
        direction[j] /= length
    return True


@lean
def next_column(columns, triangle, k, m, root):
    """Make the k-th column, of m rows and the root of the damping, orthogonal to those before it; twice."""
    column, stop = columns[k], m + k + 1
    column[m + k] = root
    for _ in range(2):
        for a in range(k):
            coefficient = dot(columns[a], column, 0, m + a + 1)  # nothing of column a is below that
            add_multiple(column, -coefficient, columns[a], m + a + 1)
            triangle[a, k] += coefficient
    size = np.sqrt(dot(column, column, 0, stop))
    triangle[k, k] = size
    for i in range(stop):
        column[i] /= size


@lean
def factor(rest, cutoff, root, basis, columns, triangle):
    """Factor the rows of one problem; ``rest`` is used up, and ``columns`` has those of ``outer`` in its rows."""
    m, n = rest.shape
    fill(basis.reshape(-1), 0.0)
    fill(columns.reshape(-1), 0.0)
    fill(triangle.reshape(-1), 0.0)
    for k in range(m):
        triangle[k, k] = 1.0
    for k in range(m):
        if not next_direction(rest, basis, k, cutoff):
            return
        for i in range(m):
            coefficient = dot(rest[i], basis[k], 0, n)
            columns[k, i] = coefficient
            add_multiple(rest[i], -coefficient, basis[k], n)
        next_column(columns, triangle, k, m, root)


def handle(frame):
    """Answer a call of XLA: arguments as in ``solvers/_row_factors.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, m, n = dimension(given, 0), dimension(given, 8), dimension(given, 16)
    rows, cutoff, damping = data(given), data(given + 8), data(given + 16)
    basis, outer, triangle, space = data(found), data(found + 8), data(found + 16), data(found + 24)
    rest, columns = matrix(space, m, n), matrix(space + 8 * m * n, m, 2 * m)
    for lane in range(lanes):
        own = vector(rows + 8 * m * n * lane, m * n)
        flat = rest.reshape(-1)
        for i in range(m * n):
            flat[i] = own[i]
        factor(
            rest, vector(cutoff, lanes)[lane], np.sqrt(vector(damping, lanes)[lane]),
            matrix(basis + 8 * m * n * lane, m, n), columns, matrix(triangle + 8 * m * m * lane, m, m),
        )  # fmt: skip
        turned = matrix(outer + 16 * m * m * lane, 2 * m, m)
        for k in range(m):
            for i in range(2 * m):
                turned[i, k] = columns[k, i]
    return 0
