"""The minimiser for a given active set: one Cholesky factorisation, and refinement against exact residuals.

The active bounds are substituted, the active rows are eliminated through their Schur complement; what is left is the
positive definite system of the free variables.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from .._pivots import INACTIVE
from ._problem import QP, active_targets

_LAST_CORRECTION = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-6}
"""A correction by this share of the answer is the last; the next would be its square, or rounding."""
_MOST_CORRECTIONS = 5
_RIDGE = {jnp.dtype("float64"): 10.0, jnp.dtype("float32"): 1.0}


class Factor(NamedTuple):
    """Factors of the optimality conditions at an active set."""

    free: Bool[Array, " n"]
    held: Bool[Array, " p"]
    lower: Float[Array, "n n"]  # Cholesky factor of the Hessian of the free variables, ones for the others
    through: Float[Array, "n p"]  # inverse Hessian times the held rows
    schur_half: Float[Array, "p p"]  # inverse of held rows' Schur complement = schur_half' schur_half


def factorize(qp: QP, hessian: Float[Array, "n n"], active: Int[Array, " n_and_p"]) -> Factor:
    """Factors at an active set; a ridge of a few roundings keeps a semidefinite Hessian from breaking it."""
    n, p = hessian.shape[0], qp.rows.shape[0]
    unit = float(jnp.finfo(hessian.dtype).eps)
    free, held = active[:n] == INACTIVE, active[n:] != INACTIVE
    diagonal = jnp.diagonal(hessian)
    ridge = _RIDGE[hessian.dtype] * unit * jnp.where(diagonal > 0.0, diagonal, jnp.maximum(jnp.max(diagonal), unit))
    square = jnp.where(free[:, None] & free[None, :], hessian, 0.0)
    lower = cholesky(square + jnp.diag(jnp.where(free, ridge, 1.0)))
    rows = jnp.where(held[:, None] & free[None, :], qp.rows, 0.0)
    if not p:
        return Factor(free, held, lower, rows.T, jnp.zeros((0, 0), hessian.dtype))
    reach = forward(lower, rows.T)
    schur = product(reach.T, reach) + jnp.diag(jnp.where(held, qp.compliance, 0.0))
    own = jnp.diagonal(schur)
    ridge = jnp.where(held, 10.0 * unit * own + jnp.where(own == 0.0, unit, 0.0), 1.0)
    return Factor(free, held, lower, backward(lower, reach), half_inverse(cholesky(schur + jnp.diag(ridge))))


def minimize_on(
    qp: QP, factor: Factor, active: Int[Array, "B n_and_p"]
) -> tuple[Float[Array, "B n"], Float[Array, "B p"]]:
    """Minimisers and row multipliers with the active constraints as equalities and the others left out.

    Every argument has a leading axis, the lanes; all are refined until the last correction is small in each.
    """
    target = jax.vmap(active_targets)(qp, active)
    n = factor.free.shape[1]

    def correction(x: Array, y: Array) -> tuple[Array, Array]:
        return jax.vmap(_correction)(qp, factor, target, x, y)

    x, y = jnp.where(factor.free, 0.0, target[:, :n]), jnp.zeros_like(target[:, n:])
    dx, dy = correction(x, y)
    root = jnp.abs(jnp.diagonal(factor.lower, axis1=1, axis2=2))
    limit = jnp.asarray(_LAST_CORRECTION[x.dtype], x.dtype)
    return refined(correction, x + dx, y + dy, root=root, limit=limit)[:2]


def refined(
    correction: Callable[[Array, Array], tuple[Array, Array]],
    x: Float[Array, "B n"],
    y: Float[Array, "B p"],
    *,
    root: Float[Array, "B n"],
    limit: Float[Array, "..."],
) -> tuple[Float[Array, "B n"], Float[Array, "B p"], Bool[Array, " B"]]:
    """x and y with corrections until the last one is small in each lane, and whether it is.

    Args:
        correction: of all lanes, from exact residuals.
        x: to be corrected.
        y: likewise.
        root: of the curvature; variables times these have one unit.
        limit: a correction by this share of x is small. () or (B,)
    """

    def go_on(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        *_, share, rounds = state
        return jnp.any(share > limit) & (rounds < _MOST_CORRECTIONS)

    def again(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, y, _, rounds = state
        dx, dy = correction(x, y)
        return x + dx, y + dy, jax.vmap(_share)(dx * root, (x + dx) * root), rounds + 1

    start = (x, y, jnp.full(len(x), jnp.inf, x.dtype), jnp.asarray(0))
    x, y, share, _ = jax.lax.while_loop(go_on, again, start)
    return x, y, share <= limit


def _share(dx: Float[Array, " n"], x: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.max(jnp.abs(dx)) / jnp.maximum(jnp.max(jnp.abs(x)), jnp.finfo(x.dtype).tiny)


def _correction(
    qp: QP, factor: Factor, target: Float[Array, " n_and_p"], x: Float[Array, " n"], y: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Of x and y, from exact residuals."""
    slope = apply(qp.rows.T, y) - qp.cost.gradient(x)
    gap = target[len(x) :] - apply(qp.rows, x) - qp.compliance * y
    return solve_system(factor, slope, gap)


def solve_system(
    factor: Factor, slope: Float[Array, " n"], gap: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """dx, dy with H dx - C'dy = slope over the free variables and C dx + D dy = gap over the held rows."""
    step = backward(factor.lower, forward(factor.lower, jnp.where(factor.free, slope, 0.0)))
    if not len(gap):
        return step, gap
    apart = apply(factor.through.T, jnp.where(factor.free, slope, 0.0))
    dy = apply(factor.schur_half.T, apply(factor.schur_half, jnp.where(factor.held, gap - apart, 0.0)))
    return step + apply(factor.through, dy), dy


def system_inverse(
    qp: QP, active: Int[Array, " n_and_p"]
) -> Callable[[Float[Array, " n_and_p"]], Float[Array, " n_and_p"]]:
    """From slope and -gap to dx and dy as in ``solve_system``; 0 for active variables and for rows that are not held.

    One refinement: products with A keep what the factor of A'WA has lost.
    """
    factor = factorize(qp, qp.cost.hessian(), active)
    n = len(factor.free)

    def solve(right: Array) -> Array:
        x, y = jnp.zeros_like(right[:n]), jnp.zeros_like(right[n:])
        for _ in range(2):
            slope = right[:n] - qp.cost.curvature(x) + apply(qp.rows.T, y)
            gap = -right[n:] - apply(qp.rows, x) - qp.compliance * y
            dx, dy = solve_system(factor, slope, jnp.where(factor.held, gap, 0.0))
            x, y = jnp.where(factor.free, x + dx, 0.0), jnp.where(factor.held, y + dy, 0.0)
        return jnp.concatenate([x, y])

    return solve


def half_inverse(lower: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """F with (lower lower')^-1 = F'F."""
    return forward(lower, jnp.eye(len(lower), dtype=lower.dtype))


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jax.lax.linalg.cholesky(matrix, symmetrize_input=False)


def forward(lower: Float[Array, "n n"], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True)


def backward(lower: Float[Array, "n n"], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True, trans=1)
