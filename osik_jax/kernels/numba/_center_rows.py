"""Kernel of ``tasks/_com.py``: the rows of a task that asks for a centre of mass, from the bodies."""

from __future__ import annotations

import numpy as np

from ._center_of_mass import center_of_lane
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers


@lean
def length(a, weight):
    """Return the Euclidean norm of the numbers ``weight_i a_i``, of whatever size."""
    size, total = 0.0, 0.0
    for i in range(len(a)):
        size = max(size, abs(weight[i] * a[i]))
    if not size > 0.0:
        return 0.0
    for i in range(len(a)):
        term = weight[i] * a[i] / size
        total += term * term
    return size * np.sqrt(total)


@lean
def size_of_turning(J, turning):
    """Return the Frobenius norm of the columns of dofs that turn something."""
    total = 0.0
    for i in range(3):
        for j in range(len(turning)):
            if turning[j] != 0:
                total += J[i, j] * J[i, j]
    return np.sqrt(total)


def handle(frame):
    """Answer a call of XLA: arguments as in ``tasks/_com.py``, each with a leading axis of lanes, or of 1."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, m, nv = dimension(found, 0), dimension(found, 8), dimension(found + 8, 16)
    bodies, full = dimension(given, 8), dimension(given + 16, 8)
    axes = whole_numbers(data(given + 48) + 4 * (bodies + 2 * full), m)
    turning = whole_numbers(data(given + 48) + 4 * (bodies + 2 * full + m), nv)
    below, point = matrix(data(found + 48), bodies, 4), vector(data(found + 48) + 32 * bodies, 3)
    J = matrix(data(found + 48) + 32 * bodies + 24, 3, nv)
    other = 8 * (3 * m + 1) * (dimension(given + 56, 0) > 1)  # bytes between lanes
    for lane in range(lanes):
        center_of_lane(given, lane, below, point, J)
        first = data(given + 56) + other * lane
        target, forward, weight = vector(first, m), vector(first + 8 * m, m), vector(first + 16 * m, m)
        gain = vector(first + 24 * m, 1)[0]
        error, rows = vector(data(found) + 8 * m * lane, m), matrix(data(found + 8) + 8 * m * nv * lane, m, nv)
        wanted, pull = vector(data(found + 16) + 8 * m * lane, m), vector(data(found + 32) + 8 * m * lane, m)
        levers = vector(data(found + 40) + 8 * nv * lane, nv)
        for i in range(m):
            error[i] = point[axes[i]] - target[i]
            pull[i] = gain * error[i]
            wanted[i] = forward[i] - pull[i]
        for j in range(nv):
            squared = 0.0
            for i in range(m):
                rows[i, j] = J[axes[i], j]
                squared += weight[i] * rows[i, j] * rows[i, j]
            levers[j] = np.sqrt(squared)
        vector(data(found + 24) + 8 * lane, 1)[0] = length(pull, weight) * size_of_turning(J, turning)
    return 0
