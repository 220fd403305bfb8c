"""The exact minimiser for a given active set: one factorisation, refined, and differentiable by plain autodiff.

At a solution the active set is locally constant, so the solution map is that of an equality-constrained problem.
Differentiating these linear solves therefore gives the implicit derivative in forward and reverse mode; nothing of
the search for the active set is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._dense import apply, product
from ._problem import AT_UPPER, INACTIVE, QP

Gradient = Callable[[Float[Array, " n"]], Float[Array, " n"]]


def solve_active_set(
    qp: QP, active: Int[Array, " m"], cost_gradient: Gradient, refinements: int = 2
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Minimiser and row multipliers with the active constraints as equalities and the others left out.

    Args:
        qp: the problem.
        active: as in ``QPSolution.active``.
        cost_gradient: x to Hx + g, as accurately as the caller can (from factors rather than from H).
        refinements: rounds of iterative refinement against ``cost_gradient``.
    """
    n, p = qp.hessian.shape[0], qp.rows.shape[0]
    target = active_targets(qp, active)
    free = active[:n] == INACTIVE
    held = active[n:] != INACTIVE
    hessian = jnp.where(free[:, None] & free[None, :], qp.hessian, jnp.diag(jnp.where(free, 0.0, 1.0)))
    half = _half_inverse(hessian)
    rows = jnp.where(held[:, None] & free[None, :], qp.rows, 0.0)
    x = jnp.where(free, 0.0, target[:n])
    y = jnp.zeros(p, x.dtype)
    if p:
        reach = product(half, rows.T)
        through = product(half.T, reach)
        schur = product(reach.T, reach)
        ridge = 10.0 * jnp.finfo(x.dtype).eps * jnp.diagonal(schur)
        schur_half = _half_inverse(schur + jnp.diag(jnp.where(held, ridge, 1.0)))
    for _ in range(1 + refinements):
        stationarity = jnp.where(free, -cost_gradient(x) + apply(qp.rows.T, jnp.where(held, y, 0.0)), 0.0)
        step = apply(half.T, apply(half, stationarity))
        if p:
            gap = jnp.where(held, target[n:] - apply(qp.rows, x + step), 0.0)
            dy = apply(schur_half.T, apply(schur_half, gap))
            step, y = step + apply(through, dy), y + dy
        x = x + step
    return x, y


def _half_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """F with matrix^-1 = F'F: two LAPACK calls once, and products for every solve after that."""
    factor = jnp.linalg.cholesky(matrix)
    return jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(matrix), dtype=matrix.dtype), lower=True)


def active_targets(qp: QP, active: Int[Array, " m"]) -> Float[Array, " m"]:
    """The bound that each active constraint sits at, 0 for the others (never infinite)."""
    at_lower = (active != INACTIVE) & (active != AT_UPPER)
    return jnp.where(at_lower, qp.lower, 0.0) + jnp.where(active == AT_UPPER, qp.upper, 0.0)
