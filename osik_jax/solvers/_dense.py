"""Small dense matrices: products in full precision on every device (GPUs default to TF32)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def product(a: Float[Array, "m k"], b: Float[Array, "k n"]) -> Float[Array, "m n"]:
    """The matrix a b."""
    return jnp.matmul(a, b, precision="highest")


def apply(a: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    """The vector a x."""
    return jnp.matmul(a, x, precision="highest")


def clip_to_box(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """x in [lower, upper]; a bound that is none (NaN, an infinity on the wrong side) is passed over."""
    return jnp.clip(x, jnp.where(lower < jnp.inf, lower, -jnp.inf), jnp.where(upper > -jnp.inf, upper, jnp.inf))
