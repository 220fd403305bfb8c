"""Small dense matrices: products in full precision on every device (GPUs default to TF32)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def product(a: Float[Array, "*B m k"], b: Float[Array, "*B k n"]) -> Float[Array, "*B m n"]:
    """Return the matrix a b, or each of a batch."""
    return jnp.matmul(a, b, precision="highest")


def apply(a: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return the vector a x."""
    return jnp.matmul(a, x, precision="highest")
