"""Rotations applied and composed.

Written out term by term: XLA fuses that into what is around it, never runs it in reduced precision, and makes no
library call of it, which sums of three numbers do not repay.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def rotate(rotation: Float[Array, "... 3 3"], vector: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """R x."""
    x, y, z = (rotation[..., i] * vector[..., i, None] for i in range(3))
    return x + y + z


def compose(a: Float[Array, "... 3 3"], b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """A B."""
    x, y, z = (a[..., i, None] * b[..., i, None, :] for i in range(3))
    return x + y + z


def cross(a: Float[Array, "..."], b: Float[Array, "..."], *, along: int = -1) -> Float[Array, "..."]:
    """a x b, along an axis of length 3."""
    ax, ay, az = (jax.lax.index_in_dim(a, i, along, keepdims=False) for i in range(3))
    bx, by, bz = (jax.lax.index_in_dim(b, i, along, keepdims=False) for i in range(3))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], along)
