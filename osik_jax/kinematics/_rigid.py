"""Rotation matrices and quaternions: applied to vectors, and composed.

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


_PRODUCT = ((1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0))
_SIGNS = ((-1, 1, -1, 1), (-1, 1, 1, -1), (-1, -1, 1, 1))
"""Entry and sign of b that x, y and z of a multiply in each entry of a quaternion product a b."""
_ZERO = 1e-8
"""A quaternion whose entries are all at most this has no direction."""


def squared_length(vector: Float[Numbers, "... n"]) -> Float[Numbers, "... 1"]:
    """Return the sum of the squared entries."""
    return (vector**2).sum(-1, keepdims=True)


def unit_quaternion(quaternion: Float[Numbers, "... 4"]) -> Float[Numbers, "... 4"]:
    """Return quaternions over their lengths; one of zeros becomes a rotation that means nothing, as in the core."""
    xp = module_of(quaternion)
    none = (abs(quaternion) <= _ZERO).all(-1, keepdims=True)
    some = xp.where(none, quaternion.dtype.type(1.0), quaternion)
    return some / xp.sqrt(squared_length(some))


def quaternion_product(a: Float[Numbers, "... 4"], b: Float[Numbers, "... 4"]) -> Float[Numbers, "... 4"]:
    """Return the quaternion of the rotation b, followed by the rotation a."""
    terms = zip((1, 2, 3), _PRODUCT, np.array(_SIGNS, a.dtype), strict=True)
    return a[..., :1] * b + sum(a[..., i, None] * (sign * b[..., list(entry)]) for i, entry, sign in terms)


def rotation_matrix(quaternion: Float[Numbers, "... 4"]) -> Float[Numbers, "... 3 3"]:
    """Return the rotation of a quaternion w, x, y, z of any length but 0.

    Made of whole arrays, for XLA makes one operation of that, and one for each entry of stacked entries.
    """
    dtype = quaternion.dtype
    half = quaternion * module_of(quaternion).sqrt(
        2.0 / squared_length(quaternion)
    )  # its products are twice a unit one's
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


def cross(a: Float[Numbers, "..."], b: Float[Numbers, "..."], *, along: int = -1) -> Float[Numbers, "..."]:
    """Return a x b, along an axis of length 3."""
    ax, ay, az = (jax.lax.index_in_dim(a, i, along, keepdims=False) for i in range(3))
    bx, by, bz = (jax.lax.index_in_dim(b, i, along, keepdims=False) for i in range(3))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], along)
