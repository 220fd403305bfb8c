"""Pseudo-inverses and damped inverses of projected rows by orthogonal factorisations, with both derivative modes.

Derivatives of the Moore-Penrose inverse are those at constant rank: G. H. Golub, V. Pereyra, "The differentiation of
pseudo-inverses and nonlinear least squares problems whose variables separate", SIAM Journal on Numerical Analysis 10,
1973, referred to as GP.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..execution._backends import Backend
from ..execution._rules import custom_jvp
from ..numerics._dense import apply, product
from ..numerics._guarded import largest
from ._row_factors import RowFactors, row_factors


@custom_jvp
def row_space_and_motion(
    matrix: Float[Array, "m n"],
    target: Float[Array, " m"],
    cutoff: Float[Array, ""],
    damping: Float[Array, ""],
    rank: Int[Array, ""] | None,
    *,
    backend: Backend = "jax",
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Return the projector onto the row space of A, and the damped solution A'(A A' + damping I)^-1 target.

    The rank is decided by pivots: rows that have no more than the cutoff outside the span of the longer ones count as
    dependent. The projector comes from an orthonormal basis and not from an inverse, so it is idempotent to roundoff
    however dependent the rows are. Derivatives are those at constant rank. ``cutoff`` is the smallest pivot that is not
    0; the damping is in squared singular values. With a ``rank``, the pivots beyond it count as 0 too.
    """
    factors = _factors(matrix, cutoff, damping, rank, backend)
    motion = apply(factors.basis.T, _solved(factors, target))
    return product(factors.basis.T, factors.basis), motion


def _factors(matrix: Array, cutoff: Array, damping: Array, rank: Array | None, backend: Backend) -> RowFactors:
    """Return the factors up to a rank at most: each pivot depends on those before it alone."""
    found = row_factors(matrix, cutoff, damping, backend)
    if rank is None:
        return found
    keep = jnp.arange(len(matrix)) < rank
    eye = jnp.eye(len(matrix), dtype=matrix.dtype)
    return RowFactors(
        basis=jnp.where(keep[:, None], found.basis, 0.0),
        orthonormal=jnp.where(keep, found.orthonormal, 0.0),
        triangle=jnp.where(keep[:, None] & keep, found.triangle, eye),
    )


def _solved(factors: RowFactors, target: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
    """Return the minimiser y of |A basis' y - target|^2 + damping |y|^2, by the QR factors."""
    # [A basis'; sqrt(damping) I] = Q R, and the right side is 0 below: R y = (upper half of Q)' target
    left = factors.orthonormal[: len(factors.basis)]
    return jax.scipy.linalg.solve_triangular(factors.triangle, jnp.matmul(left.T, target, precision="highest"))


@custom_jvp
def _by_row_factors(
    matrix: Array, cutoff: Array, damping: Array, rank: Array | None, *, backend: Backend
) -> tuple[Array, Array, Array]:
    """Return the projector onto the row space, the Moore-Penrose inverse and the damped inverse."""
    both = [_factors(matrix, cutoff, each, rank, backend) for each in (jnp.zeros_like(damping), damping)]
    eye = jnp.eye(len(matrix), dtype=matrix.dtype)
    plain, damped = (product(factors.basis.T, _solved(factors, eye)) for factors in both)
    return product(both[0].basis.T, both[0].basis), plain, damped


@_by_row_factors.defjvp
def _by_row_factors_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[Any, Any]:
    (a, cutoff, damping, rank), (da, _, d_damping, _) = primals, tangents
    space, X, D = _by_row_factors(a, cutoff, damping, rank, backend=backend)
    dX = _columns(lambda w: _inverse_rate(a, X, da, w), a)
    dD = _columns(lambda w: _damped_rate(a, X, D, damping, da, d_damping, w), a)
    return (space, X, D), (_space_rate(space, X, da), dX, dD)


@row_space_and_motion.defjvp
def _row_space_and_motion_jvp(
    primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend = "jax"
) -> tuple[Any, Any]:
    # with rows of size 1: products of four inverses would overflow for rows of 1e-10 in single precision
    size = largest(primals[0])
    (a, target, cutoff), (da, d_target) = ([each / size for each in some] for some in (primals[:3], tangents[:2]))
    damping, d_damping = primals[3] / size**2, tangents[3] / size**2
    space, X, D = _by_row_factors(a, cutoff, damping, primals[4], backend=backend)
    rate = _damped_rate(a, X, D, damping, da, d_damping, target) + apply(D, d_target)
    return (space, apply(D, target)), (_space_rate(space, X, da), rate)


def _space_rate(space: Float[Array, "n n"], X: Float[Array, "n m"], da: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """Return the derivative of the projector P = X A onto the row space, X dA (I - P) plus its transpose."""
    half = product(X, da)
    half = half - product(half, space)
    return half + half.T


def _columns(rate: Callable[[Float[Array, " m"]], Float[Array, " n"]], a: Float[Array, "m n"]) -> Float[Array, "n m"]:
    """Return the matrix of a linear map; needed for second derivatives only."""
    return jax.vmap(rate, out_axes=1)(jnp.eye(len(a), dtype=a.dtype))


def _damped_rate(
    a: Float[Array, "m n"],
    X: Float[Array, "n m"],
    D: Float[Array, "n m"],
    damping: Array,
    da: Float[Array, "m n"],
    d_damping: Array,
    w: Float[Array, " m"],
) -> Float[Array, " n"]:
    """Return the derivative of D w from (I + damping X X') D = X; for strong damping from D alone."""
    # rows are at most of size 1: with more damping than that, D is small, and differences of X would be roundoff
    is_strong = damping > 1.0
    strong = _strongly_damped_rate(a, D, jnp.where(is_strong, damping, 1.0), da, d_damping, w)
    damping = jnp.where(is_strong, 0.0, damping)
    # with M = X X': dD w = (I + damping M)^-1 (dX w - d_damping M D w - damping dM D w)
    y = apply(D, w)
    z = apply(X.T, y)
    damped = d_damping * apply(X, z) + damping * (_inverse_rate(a, X, da, z) + apply(X, _transposed_rate(a, X, da, y)))
    right = _inverse_rate(a, X, da, w) - damped
    # D = (I + damping X X')^-1 X, so
    # (I + damping X X')^-1 = I - damping D X'
    return jnp.where(is_strong, strong, right - damping * apply(D, apply(X.T, right)))


def _strongly_damped_rate(
    a: Float[Array, "m n"],
    D: Float[Array, "n m"],
    damping: Array,
    da: Float[Array, "m n"],
    d_damping: Array,
    w: Float[Array, " m"],
) -> Float[Array, " n"]:
    """Return the derivative of D w, D = K A' with K = (A'A + damping I)^-1 = (I - D A) / damping."""
    y = apply(D, w)
    right = apply(da.T, w - apply(a, y)) - d_damping * y
    return (right - apply(D, apply(a, right))) / damping - apply(D, apply(da, y))


def _inverse_rate(
    a: Float[Array, "m n"], X: Float[Array, "n m"], da: Float[Array, "m n"], w: Float[Array, " m"]
) -> Float[Array, " n"]:
    """Return the derivative of X w with X the Moore-Penrose inverse of A (Golub and Pereyra).

    dX = -X dA X + X X' dA' (I - A X) + (I - X A) dA' X' X.
    """
    x = apply(X, w)
    wide = apply(X, apply(X.T, apply(da.T, w - apply(a, x))))
    tall = apply(da.T, apply(X.T, x))
    return wide + tall - apply(X, apply(a, tall)) - apply(X, apply(da, x))


def _transposed_rate(
    a: Float[Array, "m n"], X: Float[Array, "n m"], da: Float[Array, "m n"], v: Float[Array, " n"]
) -> Float[Array, " m"]:
    """Return the derivative of X' v by the transpose of the formula in ``_inverse_rate``."""
    y = apply(X.T, v)
    wide = apply(da, apply(X, y))
    tall = apply(X.T, apply(X, apply(da, v - apply(X, apply(a, v)))))
    return wide - apply(a, apply(X, wide)) + tall - apply(X.T, apply(da.T, y))
