"""Linear systems of a whole clip: frames that are coupled to the one and the two before."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
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
    and ``L L^T = A - L1 L1^T - L2 L2^T``. The blocks on the diagonal are kept as inverses: of blocks this small,
    products take a third of the time of substitutions.
    """
    n = right.shape[-1]
    identity, zero = jnp.eye(n, dtype=right.dtype), jnp.zeros((n, n), right.dtype)
    none = jnp.zeros(n, right.dtype)
    first = system.first.at[0].set(0.0)
    second = system.second.at[:2].set(0.0)

    def down(carry, row):
        inverse1, inverse2, below1, y1, y2 = carry
        diagonal, one_back, two_back, b = row
        far = two_back[:, None] * inverse2.T
        near = (one_back - far @ below1.T) @ inverse1.T
        both = jnp.concatenate([near, far], 1)
        factor = lax.linalg.cholesky(diagonal - both @ both.T, symmetrize_input=False)
        inverse = lax.linalg.triangular_solve(factor, identity, left_side=True, lower=True)
        y = inverse @ (b - near @ y1 - far @ y2)
        return (inverse, inverse1, near, y, y1), (inverse, near, y)

    _, (inverse, near, y) = lax.scan(
        down, (identity, identity, zero, none, none), (system.diagonal, first, second, right)
    )

    def up(carry, row):
        x1, x2, near1 = carry
        inverse, near, y, two_on = row
        # row t + 2 couples to t by L2 = S L[t]^-T, so that L2^T x = L[t]^-1 S x
        x = inverse.T @ (y - near1.T @ x1 - inverse @ (two_on * x2))
        return (x, x1, near), x

    two_on = jnp.roll(second, -2, 0)
    _, x = lax.scan(up, (none, none, zero), (inverse, near, y, two_on), reverse=True)
    return x
