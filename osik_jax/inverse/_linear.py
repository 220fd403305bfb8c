"""Small positive definite systems, one a lane, lanes last."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

ISOLATED = 0.01
"""A robot is not singular where each motion by 1 rad changes a row by this, relative to what a radian counts as."""


def positive_pivot(matrix: Float[Array, "m n lanes"]) -> Float[Array, " lanes"]:
    """Return the smallest pivot of ``matrix' matrix``: 0 where a motion along it changes no row."""
    squares = jnp.sum(matrix[:, :, None] * matrix[:, None], 0)
    return solve_with_pivots(squares, jnp.zeros_like(matrix[0]))[1]


def solve_positive(matrix: Float[Array, "m m lanes"], vector: Float[Array, "m lanes"]) -> Float[Array, "m lanes"]:
    """Return matrix^-1 vector by elimination without pivoting, which a positive definite matrix allows."""
    return solve_with_pivots(matrix, vector)[0]


def solve_with_pivots(
    matrix: Float[Array, "m m lanes"], vector: Float[Array, "m lanes"]
) -> tuple[Float[Array, "m lanes"], Float[Array, " lanes"]]:
    """Return matrix^-1 vector as ``solve_positive``, and the smallest pivot, which is positive if the matrix is.

    A loop over rows, each pass on all lanes: batched LAPACK calls on matrices of six rows cost many times as much.
    """

    def eliminate(at: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        both, least = carry
        row = jax.lax.dynamic_index_in_dim(both, at, 0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(both, at, 1, keepdims=True)
        pivot = jax.lax.dynamic_index_in_dim(row, at, 0, keepdims=False)
        row = row / pivot
        both = jax.lax.dynamic_update_index_in_dim(both - column * row, row, at, 0)
        return both, jnp.minimum(least, pivot)

    both = jnp.concatenate([matrix, vector[:, None]], 1)
    both, least = jax.lax.fori_loop(0, len(matrix), eliminate, (both, jnp.full_like(vector[0], jnp.inf)))
    return both[:, -1], least
