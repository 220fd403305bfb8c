"""Small positive definite systems, one a lane, lanes last."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def solve_positive(matrix: Float[Array, "m m lanes"], vector: Float[Array, "m lanes"]) -> Float[Array, "m lanes"]:
    """matrix^-1 vector by elimination without pivoting, which a positive definite matrix allows.

    A loop over rows, each pass on all lanes: batched LAPACK calls on matrices of six rows cost many times as much.
    """

    def eliminate(at: Array, both: Array) -> Array:
        row = jax.lax.dynamic_index_in_dim(both, at, 0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(both, at, 1, keepdims=True)
        row = row / jax.lax.dynamic_index_in_dim(row, at, 0, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(both - column * row, row, at, 0)

    both = jnp.concatenate([matrix, vector[:, None]], 1)
    return jax.lax.fori_loop(0, len(matrix), eliminate, both)[:, -1]
