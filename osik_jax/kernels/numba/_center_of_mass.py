"""Kernel of ``kinematics/_forward.py``: the centre of mass and its Jacobian, one configuration after another."""

from __future__ import annotations

from ._dense import fill
from ._frame import arguments, compiled, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._rigid import cross, minus, plus, triple, turning
from ._rigid import turned as rotated


@lean
def add_up(parents, masses, centers, P, R, below):
    """Sum mass, and mass times centre, of each body with all below it, into ``below`` (nbody, 4)."""
    for body in range(len(parents)):
        at = plus(triple(P, body), rotated(turning(R, body), triple(centers, body)))
        below[body, 0] = masses[body]
        for i in range(3):
            below[body, 1 + i] = masses[body] * at[i]
    for body in range(len(parents) - 1, 0, -1):
        for i in range(4):
            below[parents[body], i] += below[body, i]


@lean
def move_center(J, below, owners, columns, factors, lin, ang, anchors):
    """Write the Jacobian into J (3, nv): the mass that each dof moves, at its centre, over the whole mass."""
    whole = below[0, 0]
    for dof in range(len(columns)):
        column = columns[dof]
        if column < 0:
            continue
        body, ratio = owners[dof], factors[dof] / whole
        mass, anchor, along = below[body, 0], triple(anchors, dof), triple(lin, dof)
        arm = minus(
            (below[body, 1], below[body, 2], below[body, 3]), (mass * anchor[0], mass * anchor[1], mass * anchor[2])
        )
        speed = cross(triple(ang, dof), arm)
        for i in range(3):
            J[i, column] += ratio * (mass * along[i] + speed[i])


@compiled
def center_of_lane(given, lane, below, point, J):
    """Write the centre of one lane into ``point`` (3,) and its Jacobian into J (3, nv).

    Args:
        given: the arguments of ``handle``.
        lane: its number.
        below: space, as in ``add_up``.
        point: the centre.
        J: the Jacobian.
    """
    bodies, full, whole = dimension(given, 8), dimension(given + 16, 8), dimension(given + 40, 8)
    # numbers between the lanes of each argument, 0 where all have the same
    body, dof = bodies * (dimension(given, 0) > 1), full * (dimension(given + 16, 0) > 1)
    other, numbers = whole * (dimension(given + 40, 0) > 1), data(given + 48)
    parents, owners = whole_numbers(numbers, bodies), whole_numbers(numbers + 4 * bodies, full)
    columns = whole_numbers(numbers + 4 * (bodies + full), full)
    first, shift = data(given + 40) + 8 * other * lane, 24 * dof * lane
    factors, masses, at = vector(first, full), vector(first + 8 * full, bodies), first + 8 * (full + bodies)
    P, R = matrix(data(given) + 24 * body * lane, bodies, 3), matrix(data(given + 8) + 72 * body * lane, bodies, 9)
    add_up(parents, masses, matrix(at, bodies, 3), P, R, below)
    for i in range(3):
        point[i] = below[0, 1 + i] / below[0, 0]
    for i in range(3):
        fill(J[i], 0.0)
    lin, ang = matrix(data(given + 16) + shift, full, 3), matrix(data(given + 24) + shift, full, 3)
    move_center(J, below, owners, columns, factors, lin, ang, matrix(data(given + 32) + shift, full, 3))


def handle(frame):
    """Answer a call of XLA: arguments as in ``kinematics/_kernels.py``, each with a leading axis of lanes, or of 1."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, nv, below = dimension(found, 0), dimension(found + 8, 16), matrix(data(found + 16), dimension(given, 8), 4)
    for lane in range(lanes):
        J = matrix(data(found + 8) + 24 * nv * lane, 3, nv)
        center_of_lane(given, lane, below, vector(data(found) + 24 * lane, 3), J)
    return 0
