"""Small dense matrices: products in full precision on every device (GPUs default to TF32), and a pseudo-inverse."""

from __future__ import annotations

from typing import Any

import jax
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


@jax.custom_jvp
def pseudo_inverses(matrix: Float[Array, "m n"], cutoff: Array, damping: Array) -> tuple[Array, Array]:
    """Moore-Penrose inverse and damped inverse (n, m), singular values up to the cutoff left out of both.

    Their derivatives are those at constant rank.
    """
    u, s, vt = jnp.linalg.svd(matrix, full_matrices=False)
    real = s > cutoff
    s = jnp.where(real, s, 1.0)
    plain, damped = (product(vt.T * jnp.where(real, f, 0.0), u.T) for f in (1.0 / s, s / (s**2 + damping)))
    return plain, damped


@pseudo_inverses.defjvp
def _pseudo_inverses_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Any, Any]:
    (a, cutoff, damping), (da, _, d_damping) = primals, tangents
    inverses = pseudo_inverses(a, cutoff, damping)
    return inverses, inverse_rates(a, *inverses, damping, da, d_damping)


def inverse_rates(
    a: Float[Array, "m n"], X: Float[Array, "n m"], D: Float[Array, "n m"], d: Array, da: Array, dd: Array
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """Rates of the Moore-Penrose inverse X of a and of the damped inverse D, at constant rank.

    G. H. Golub, V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973, for X; D solves (I + d X X') D = X.
    """
    wide = product(X, product(X.T, da.T))
    tall = product(product(da.T, X.T), X)
    dX = wide - product(product(wide, a), X) + tall - product(X, product(a, tall)) - product(product(X, da), X)
    moved = dd * product(X, product(X.T, D)) + d * (product(dX, product(X.T, D)) + product(X, product(dX.T, D)))
    dD = dX - moved
    return dX, dD - d * product(D, product(X.T, dD))  # (I + d X X')^-1 = I - d D X'
