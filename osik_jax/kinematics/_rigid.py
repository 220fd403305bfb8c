"""Rotation matrices: from quaternions, applied to vectors, and composed.

Written out term by term: XLA fuses that into what is around it, never runs it in reduced precision, and makes no
library call of it, which sums of three numbers do not repay.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_GENERATORS = np.cross(np.eye(3)[:, None], np.eye(3)).mT
"""``[x]``, ``[y]`` and ``[z]``: the matrices of cross products with the axes."""


def rotation_matrix(quaternion: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Return the rotation of a quaternion w, x, y, z of any length but 0; by NumPy of NumPy's array.

    Made of whole arrays, for XLA makes one operation of that, and one for each entry of stacked entries.
    """
    dtype, numbers = quaternion.dtype, np if isinstance(quaternion, np.ndarray) else jnp
    half = quaternion * numbers.sqrt(2.0 / numbers.sum(quaternion**2, -1, keepdims=True))
    # products of `half` are twice a unit one's
    (w, x, y, z), v = (half[..., i, None, None] for i in range(4)), half[..., 1:]
    turn = w * sum(a * generator for a, generator in zip((x, y, z), _GENERATORS.astype(dtype), strict=True))
    stretch = (1.0 - (x * x + y * y + z * z)) * np.eye(3, dtype=dtype)
    return stretch + v[..., :, None] * v[..., None, :] + turn


def rotate(rotation: Float[Array, "... 3 3"], vector: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Return R x."""
    x, y, z = (rotation[..., i] * vector[..., i, None] for i in range(3))
    return x + y + z


def compose(a: Float[Array, "... 3 3"], b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Return A B."""
    x, y, z = (a[..., i, None] * b[..., i, None, :] for i in range(3))
    return x + y + z


def cross(a: Float[Array, "..."], b: Float[Array, "..."], *, along: int = -1) -> Float[Array, "..."]:
    """Return a x b, along an axis of length 3."""
    ax, ay, az = (jax.lax.index_in_dim(a, i, along, keepdims=False) for i in range(3))
    bx, by, bz = (jax.lax.index_in_dim(b, i, along, keepdims=False) for i in range(3))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], along)
