"""Rotation matrices: from quaternions, applied to vectors, and composed.

Written out term by term: XLA fuses that into what is around it, never runs it in reduced precision, and makes no
library call of it, which sums of three numbers do not repay.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics._host import Numbers, module_of

_GENERATORS = np.cross(np.eye(3)[:, None], np.eye(3)).mT
"""``[x]``, ``[y]`` and ``[z]``: the matrices of cross products with the axes."""
_TABLE = np.zeros((4, 4, 3, 3))
"""The rotation of a unit quaternion p: entries i, j are the sums of ``p[a] p[b] _TABLE[a, b, i, j]``."""
_TABLE[0, 0], _TABLE[0, 1:] = np.eye(3), 2.0 * _GENERATORS
for _i in range(3):
    _TABLE[_i + 1, _i + 1] -= np.eye(3)
    _TABLE[_i + 1, 1:, _i] += 2.0 * np.eye(3)


def rotation_matrix(quaternion: Float[Numbers, "... 4"]) -> Float[Numbers, "... 3 3"]:
    """Return the rotation of a quaternion w, x, y, z of any length but 0.

    Made of whole arrays, for XLA makes one operation of that, and one for each entry of stacked entries. On the host
    the fewest operations of NumPy.
    """
    dtype, many = quaternion.dtype, quaternion.shape[:-1]
    if module_of(quaternion) is np:
        unit = quaternion / np.sqrt((quaternion**2).sum(-1, keepdims=True))
        columns = (unit @ _TABLE.reshape(4, 36).astype(dtype)).reshape(*many, 4, 9)
        return (unit[..., None, :] @ columns).reshape(*many, 3, 3)
    half = quaternion * jnp.sqrt(2.0 / (quaternion**2).sum(-1, keepdims=True))  # its products are twice a unit one's
    (w, x, y, z), v = (half[..., i, None, None] for i in range(4)), half[..., 1:]
    turn = w * sum(a * generator for a, generator in zip((x, y, z), _GENERATORS.astype(dtype), strict=True))
    stretch = (1.0 - (x * x + y * y + z * z)) * np.eye(3, dtype=dtype)
    return stretch + v[..., :, None] * v[..., None, :] + turn


def rotate(rotation: Float[Numbers, "... 3 3"], vector: Float[Numbers, "... 3"]) -> Float[Numbers, "... 3"]:
    """Return R x."""
    x, y, z = (rotation[..., i] * vector[..., i, None] for i in range(3))
    return x + y + z


def compose(a: Float[Numbers, "... 3 3"], b: Float[Numbers, "... 3 3"]) -> Float[Numbers, "... 3 3"]:
    """Return A B."""
    x, y, z = (a[..., i, None] * b[..., i, None, :] for i in range(3))
    return x + y + z


def compose_poses(
    first: tuple[Float[Numbers, "... 3"], Float[Numbers, "... 3 3"]],
    second: tuple[Float[Numbers, "... 3"], Float[Numbers, "... 3 3"]],
) -> tuple[Float[Numbers, "... 3"], Float[Numbers, "... 3 3"]]:
    """Return poses in the outer frame from ``second``, those in a frame whose pose is ``first``."""
    return first[0] + rotate(first[1], second[0]), compose(first[1], second[1])


def cross(a: Float[Numbers, "..."], b: Float[Numbers, "..."], *, along: int = -1) -> Float[Numbers, "..."]:
    """Return a x b, along an axis of length 3."""
    ax, ay, az = (jax.lax.index_in_dim(a, i, along, keepdims=False) for i in range(3))
    bx, by, bz = (jax.lax.index_in_dim(b, i, along, keepdims=False) for i in range(3))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], along)
