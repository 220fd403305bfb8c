"""``kinematics/_manifold.py`` for kernels: moving along the manifold of configurations, and its inverse."""

from __future__ import annotations

import numpy as np

from ...numerics._constants import SMALL_TURN_SQUARED
from ._frame import lean
from ._rigid import multiplied


@lean
def _unit(q, at):
    length = np.sqrt(q[at] ** 2 + q[at + 1] ** 2 + q[at + 2] ** 2 + q[at + 3] ** 2)
    return q[at] / length, q[at + 1] / length, q[at + 2] / length, q[at + 3] / length


@lean
def integrate(scalars, turns, q, v, out):
    """``out`` becomes the configuration that is reached from q at velocity v in unit time.

    Args:
        scalars: where numbers that simply add are in q, and then in v. (2 k,)
        turns: where quaternions are in q, and then their rotations in v. (2 k,)
        q: where it begins.
        v: the velocity.
        out: where it ends.
    """
    count = len(scalars) // 2
    for k in range(count):
        out[scalars[k]] = q[scalars[k]] + v[scalars[count + k]]
    count = len(turns) // 2
    for k in range(count):
        at, dof = turns[k], turns[count + k]
        x, y, z = v[dof], v[dof + 1], v[dof + 2]
        square = x * x + y * y + z * z
        if square < SMALL_TURN_SQUARED:
            cosine = 1.0 - square / 8.0 + square * square / 384.0
            factor = 0.5 - square / 48.0 + square * square / 3840.0
        else:
            angle = np.sqrt(square)
            cosine, factor = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
        w, x, y, z = multiplied(_unit(q, at), (cosine, factor * x, factor * y, factor * z))
        length = np.sqrt(w * w + x * x + y * y + z * z)
        out[at], out[at + 1], out[at + 2], out[at + 3] = w / length, x / length, y / length, z / length


@lean
def difference(scalars, turns, a, b, out):
    """``out`` becomes the velocity that goes from a to b in unit time; rotations go the short way round."""
    count = len(scalars) // 2
    for k in range(count):
        out[scalars[count + k]] = b[scalars[k]] - a[scalars[k]]
    count = len(turns) // 2
    for k in range(count):
        at, dof = turns[k], turns[count + k]
        w, x, y, z = _unit(a, at)
        w, x, y, z = multiplied((w, -x, -y, -z), _unit(b, at))
        square = x * x + y * y + z * z
        if square < SMALL_TURN_SQUARED:
            factor = (2.0 - 2.0 / 3.0 * square / (w * w)) / w
        else:
            sine = np.sqrt(square)
            factor = 2.0 * np.arctan2(sine if w >= 0.0 else -sine, abs(w)) / sine
        out[dof], out[dof + 1], out[dof + 2] = factor * x, factor * y, factor * z
