"""Errors of poses, lanes last."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

# below this, angle over sine of half the angle is 2 up to 1e-12
_SMALL_SINE_SQUARED = 1e-12


def rotation_error(
    rotation: Float[Array, "frames 3 3 lanes"], target: Float[Array, "frames 3 3 lanes"]
) -> Float[Array, "frames 3 lanes"]:
    """Return axis times angle, in world axes, of the turn from the target to the rotation; angles up to pi [rad]."""
    first, second, third = (rotation[:, :, None, i] * target[:, None, :, i] for i in range(3))
    wxyz = _quaternion(first + second + third)
    # q and -q are the same rotation; with w >= 0 the angle is at most pi
    wxyz = jnp.where(wxyz[:, :1] < 0.0, -wxyz, wxyz)
    cosine, vector = wxyz[:, :1], wxyz[:, 1:]
    squared = jnp.sum(vector**2, 1, keepdims=True)
    small = squared < _SMALL_SINE_SQUARED
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    return vector * jnp.where(small, 2.0, 2.0 * jnp.arctan2(sine, cosine) / sine)


def _quaternion(m: Float[Array, "frames 3 3 lanes"]) -> Float[Array, "frames 4 lanes"]:
    """Return the quaternion of a rotation, from the largest of its four entries (Shepperd 1978)."""
    x, y, z = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = jnp.stack([x + y + z, x - y - z, y - x - z, z - x - y], 1)  # 4 times the square of each, less 1
    less = [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]]
    more = [m[:, 2, 1] + m[:, 1, 2], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 0] + m[:, 0, 1]]
    w_, x_, y_, z_ = (1.0 + squares[:, i] for i in range(4))
    candidates = [
        jnp.stack([w_, less[0], less[1], less[2]], 1),
        jnp.stack([less[0], x_, more[2], more[1]], 1),
        jnp.stack([less[1], more[2], y_, more[0]], 1),
        jnp.stack([less[2], more[1], more[0], z_], 1),
    ]
    best, largest = candidates[0], squares[:, :1]
    for i in (1, 2, 3):
        larger = squares[:, i : i + 1] > largest
        best = jnp.where(larger, candidates[i], best)
        largest = jnp.where(larger, squares[:, i : i + 1], largest)
    return best * (0.5 / jnp.sqrt(1.0 + largest))
