"""Inverses of projected rows, from one singular value decomposition each, with derivatives in both modes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._dense import product


@jax.custom_jvp
def row_space_and_inverse(
    matrix: Float[Array, "m n"], cutoff: Array | float, most: Int[Array, ""] | int, damping: Array | float
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """Orthogonal projector onto what the rows span, and damped inverse, of the largest singular values.

    Those up to the cutoff are left out, and those beyond the first ``most``. The projector comes from singular vectors
    and not from an inverse, so that it is one to the last digit however small the singular values are. Derivatives are
    those at constant rank.
    """
    space, _, damped = _factors(matrix, cutoff, most, damping)
    return space, damped


def _factors(
    matrix: Array, cutoff: Array | float, most: Array | int, damping: Array | float
) -> tuple[Array, Array, Array]:
    u, s, vt = jnp.linalg.svd(matrix, full_matrices=False)
    real = (s > cutoff) & (jnp.arange(len(s)) < most)
    vt, s = jnp.where(real[:, None], vt, 0.0), jnp.where(real, s, 1.0)
    plain, damped = (product(vt.T * factor, u.T) for factor in (1.0 / s, s / (s**2 + damping)))
    return product(vt.T, vt), plain, damped


@row_space_and_inverse.defjvp
def _row_space_and_inverse_jvp(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    (a, cutoff, most, damping), (da, *_, d_damping) = primals, tangents
    space, plain, damped = _factors(a, cutoff, most, damping)
    turn = product(plain, da)
    turn = turn - product(turn, space)
    d_damped = _damped_rate(a, plain, damped, damping, da, d_damping)
    return (space, damped), (turn + turn.T, d_damped)


def _damped_rate(
    a: Float[Array, "m n"], X: Float[Array, "n m"], D: Float[Array, "n m"], d: Array, da: Array, dd: Array
) -> Float[Array, "n m"]:
    """Rate of the damped inverse D of a, at constant rank, X being the Moore-Penrose inverse.

    D solves (I + d X X') D = X, whose rate is from
    G. H. Golub, V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973.
    """
    wide = product(X, product(X.T, da.T))
    tall = product(product(da.T, X.T), X)
    dX = wide - product(product(wide, a), X) + tall - product(X, product(a, tall)) - product(product(X, da), X)
    moved = dd * product(X, product(X.T, D)) + d * (product(dX, product(X.T, D)) + product(X, product(dX.T, D)))
    dD = dX - moved
    return dD - d * product(D, product(X.T, dD))  # (I + d X X')^-1 = I - d D X'


@jax.custom_jvp
def regularised_inverse(
    matrix: Float[Array, "m n"], cutoff: Float[Array, ""], damping: Float[Array, ""]
) -> Float[Array, "n m"]:
    """(A'A + damping I)^-1 A', nothing cut off; for a damping of 0 the Moore-Penrose inverse, with the cutoff."""
    return _with_gram(matrix, cutoff, damping)[0]


def _with_gram(matrix: Array, cutoff: Array, damping: Array) -> tuple[Array, Array]:
    """The inverse D, and K with D = K A': (A'A + damping I)^-1, or (A'A)^+ for a damping of 0."""
    u, s, vt = jnp.linalg.svd(matrix, full_matrices=False)
    damped = damping > 0.0
    kept = damped | (s > cutoff)
    square = jnp.where(kept, s**2 + damping, 1.0)
    inverse = product(vt.T * jnp.where(kept, s / square, 0.0), u.T)
    outside = jnp.where(damped, 1.0 / jnp.where(damped, damping, 1.0), 0.0)
    gram = product(vt.T * (jnp.where(kept, 1.0 / square, 0.0) - outside), vt)
    return inverse, gram + outside * jnp.eye(matrix.shape[1], dtype=matrix.dtype)


@regularised_inverse.defjvp
def _regularised_inverse_jvp(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    """Of K A' where it is damped; of the Moore-Penrose inverse at constant rank (Golub, Pereyra 1973) where not."""
    (a, cutoff, damping), (da, _, d_damping) = primals, tangents
    D, K = _with_gram(a, cutoff, damping)
    rest = da.T - product(product(da.T, a), D)  # da' (I - A D)
    turned = product(da.T, product(D.T, D))
    turn = jnp.where(damping > 0.0, 0.0, turned - product(D, product(a, turned)))  # (I - D A) da' D' D
    return D, product(K, rest) - product(D, product(da, D)) + turn - d_damping * product(K, D)
