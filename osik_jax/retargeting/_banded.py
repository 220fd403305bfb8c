"""Linear systems of a whole clip: frames that are coupled to the one and the two before."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float


class BandedSystem(NamedTuple):
    """A symmetric positive definite matrix of F x F blocks, with a band of two blocks below the diagonal.

    Attributes:
        diagonal: block (t, t). (F, n, n)
        first: block (t, t - 1); entry 0 is not used. (F, n, n)
        second: diagonal of block (t, t - 2), which has no other entries; entries 0 and 1 are not used. (F, n)
    """

    diagonal: Float[Array, "F n n"]
    first: Float[Array, "F n n"]
    second: Float[Array, "F n"]


def solve_banded(system: BandedSystem, right: Float[Array, "F n"]) -> Float[Array, "F n"]:
    """The solution x of ``system x = right``, by a Cholesky factorisation from the first block to the last.

    With L the factor, row t of blocks is ``L2 = S L[t-2]^-T`` (two frames back), ``L1 = (B - L2 L1[t-1]^T) L[t-1]^-T``
    and ``L L^T = A - L1 L1^T - L2 L2^T``.
    """
    n = right.shape[-1]
    identity, zero = jnp.eye(n, dtype=right.dtype), jnp.zeros((n, n), right.dtype)
    first = system.first.at[0].set(0.0)
    second = system.second.at[:2].set(0.0)

    def down(carry, row):
        factor1, factor2, below1, y1, y2 = carry
        diagonal, one_back, two_back, b = row
        far = solve_triangular(factor2, jnp.diag(two_back), lower=True).T
        near = solve_triangular(factor1, (one_back - far @ below1.T).T, lower=True).T
        factor = jnp.linalg.cholesky(diagonal - near @ near.T - far @ far.T)
        y = solve_triangular(factor, b - near @ y1 - far @ y2, lower=True)
        return (factor, factor1, near, y, y1), (factor, near, far, y)

    start = (identity, identity, zero, jnp.zeros(n, right.dtype), jnp.zeros(n, right.dtype))
    _, (factor, near, far, y) = jax.lax.scan(down, start, (system.diagonal, first, second, right))

    def up(carry, row):
        x1, x2, near1, far2, far1 = carry
        factor, near, far, y = row
        x = solve_triangular(factor, y - near1.T @ x1 - far2.T @ x2, lower=True, trans="T")
        return (x, x1, near, far1, far), x

    # the block that couples frame t to t + 2 was made in row t + 2, so it arrives two steps late on the way back
    start = (jnp.zeros(n, right.dtype), jnp.zeros(n, right.dtype), zero, zero, zero)
    _, x = jax.lax.scan(up, start, (factor, near, far, y), reverse=True)
    return x
