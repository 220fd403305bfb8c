"""For the kernel of ``retargeting/_plan.py``: where a robot is at a configuration, and rows out of how dofs move it."""

from __future__ import annotations

from ._clip_workspace import FULL, KEYS, ROOT, STRAIGHT
from ._dense import fill, reordered
from ._frame import lean
from ._kinematics import place_bodies, turn_with_bodies
from ._rigid import composed, cross, minus, plus, put, put_turning, triple, turning
from ._rigid import turned as rotated


@lean
def place(K, V, W, q):
    """Where bodies, points and trunk are at a configuration, and how dofs move them."""
    for i in range(len(K.source)):
        W.value[i] = V.coefficient[i] * q[K.source[i]] + V.offset[i]
    place_bodies(
        K.parents, K.kinds, K.owners, W.value, V.reference, V.body_at, V.body_along, V.joint_at, V.joint_along,
        W.position, W.rotation, W.linear, W.angular, W.anchors,
    )  # fmt: skip
    turn_with_bodies(K.kinds, K.owners, W.rotation, W.angular)
    origin = triple(W.position, K.counts[ROOT])
    for dof in range(K.counts[FULL]):
        axis = triple(W.angular, dof)
        speed = plus(triple(W.linear, dof), cross(minus(triple(W.anchors, dof), origin), axis))
        for i in range(3):
            W.motion[i, dof], W.motion[3 + i, dof] = speed[i], axis[i]
    for k in range(len(K.places)):
        body = K.places[k]
        put(W.points, k, plus(triple(W.position, body), rotated(turning(W.rotation, body), triple(V.points, k))))
    for k in range(4):
        body = K.places[K.counts[KEYS] + k]
        put_turning(W.turned, k, composed(turning(W.rotation, body), turning(V.turns, k)))


@lean(fastmath=reordered)
def add_rates(line, mask, motion, d, m):
    """Adds the rates along d of a point whose moment is m, by the dofs that the mask has."""
    for j in range(len(line)):
        line[j] += mask[j] * (
            d[0] * motion[0, j] + d[1] * motion[1, j] + d[2] * motion[2, j]
            + m[0] * motion[3, j] + m[1] * motion[4, j] + m[2] * motion[5, j]
        )  # fmt: skip


@lean
def add_point(K, W, k, d):
    """Adds the rates of place k along d to the line."""
    moment = cross(minus(triple(W.points, k), triple(W.position, K.counts[ROOT])), d)
    add_rates(W.line, W.masks[K.places[k]], W.motion, d, moment)


@lean
def put_row(K, V, W, J, row, scale, residual, n):
    """Put the line as a row of J, by dofs that are independent, with its residual behind it; the line is cleared."""
    if K.counts[STRAIGHT] != 0:
        for j in range(n):
            J[row, j] = scale * W.line[j]
    else:
        fill(J[row], 0.0)
        for dof in range(len(K.columns)):
            if K.columns[dof] >= 0:
                J[row, K.columns[dof]] += scale * V.factors[dof] * W.line[dof]
    J[row, n] = scale * residual
    fill(W.line, 0.0)


@lean
def unit(i):
    """Return the i-th axis."""
    return 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0
