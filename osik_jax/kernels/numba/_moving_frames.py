"""Kernel of ``kinematics/_forward.py``: poses and Jacobians of frames, one configuration after another."""

from __future__ import annotations

from ._dense import fill
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._rigid import composed, cross, minus, plus, put, put_turning, triple, turning
from ._rigid import turned as rotated


@lean
def move_frame(J, at, moved, columns, factors, lin, ang, anchors):
    """Write the Jacobian of a point that goes along with a body: [linear; angular] rows.

    Args:
        J: (6, nv)
        at: where the point is.
        moved: whether each dof moves it. (nvfull,)
        columns: that each dof adds to, -1 for none. (nvfull,)
        factors: with which it does. (nvfull,)
        lin: direction of each dof. (nvfull, 3)
        ang: axis of each dof. (nvfull, 3)
        anchors: points on the axes. (nvfull, 3)
    """
    for dof in range(len(columns)):
        column, factor = columns[dof], factors[dof]
        if column < 0 or moved[dof] == 0:
            continue
        axis = triple(ang, dof)
        speed = plus(triple(lin, dof), cross(axis, minus(at, triple(anchors, dof))))
        for i in range(3):
            J[i, column] += factor * speed[i]
            J[3 + i, column] += factor * axis[i]


def handle(frame):
    """Answer a call of XLA: arguments as in ``kinematics/_kernels.py``, each with a leading axis of lanes, or of 1."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    bodies, full, whole = dimension(given, 8), dimension(given + 16, 8), dimension(given + 40, 8)
    lanes, count, nv = dimension(found, 0), dimension(found, 8), dimension(found + 16, 24)
    # numbers between the lanes of each argument, 0 where all have the same
    body = bodies * (dimension(given, 0) > 1)
    dof, other = full * (dimension(given + 16, 0) > 1), whole * (dimension(given + 40, 0) > 1)
    numbers = data(given + 48)
    owners, columns = whole_numbers(numbers, count), whole_numbers(numbers + 4 * count, full)
    for lane in range(lanes):
        P, R = matrix(data(given) + 24 * body * lane, bodies, 3), matrix(data(given + 8) + 72 * body * lane, bodies, 9)
        shift, first = 24 * dof * lane, data(given + 40) + 8 * other * lane
        lin, ang = matrix(data(given + 16) + shift, full, 3), matrix(data(given + 24) + shift, full, 3)
        anchors, factors = matrix(data(given + 32) + shift, full, 3), vector(first, full)
        own, turns = matrix(first + 8 * full, count, 3), matrix(first + 8 * full + 24 * count, count, 9)
        points = matrix(data(found) + 24 * count * lane, count, 3)
        rotations = matrix(data(found + 8) + 72 * count * lane, count, 9)
        for k in range(count):
            carrier = turning(R, owners[k])
            at = plus(triple(P, owners[k]), rotated(carrier, triple(own, k)))
            put(points, k, at)
            put_turning(rotations, k, composed(carrier, turning(turns, k)))
            start = data(found + 16) + 48 * nv * (count * lane + k)
            fill(vector(start, 6 * nv), 0.0)
            moved = whole_numbers(numbers + 4 * (count + full + k * full), full)
            move_frame(matrix(start, 6, nv), at, moved, columns, factors, lin, ang, anchors)
    return 0
