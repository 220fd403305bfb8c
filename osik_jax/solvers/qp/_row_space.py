"""Minimiser for a given active set by a linear system of the size of the cost's rows instead of the variables.

Whole-body tasks have fewer rows than the robot has dofs: 18 for two feet, the centre of mass and a hand, 35 dofs of a
G1. With B the rows of A times the roots of their weights, and the active rows of C, each column over the root of its
damping (Sherman, Morrison and Woodbury),

    S z = [W^(1/2) (b - A c); d - C c],    x = c + D^(-1/2) B'z,    S = B B' + diag(1, compliance),

where x is free; elsewhere c is the bound. The Hessian is never formed, nor factored. It follows from stationarity,
D (x - c) = A'W^(1/2) z_1 + C'z_2, with z_1 = W^(1/2) (b - A x) and z_2 the multipliers of the active rows.

What is lost: the correction of a refinement cancels down to weight / damping in units of machine epsilon, and S is
singular where rows depend on each other. Where the first is too much, or a pivot too small, the problem is left to the
factor of the Hessian (``_kkt_solve.py``).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._lanes import choose
from ...numerics._constants import (
    INACTIVE,
    MAX_CONTRACTION,
    MAX_ROW_RATIO,
    ROW_SPACE_ACCURACY,
    ROW_SPACE_CORRECTION,
    ROW_SPACE_PIVOT,
)
from ...numerics._dense import apply, product
from .._goldfarb_idnani import Roundoff
from ._cost import LeastSquares
from ._kkt_solve import backward, cholesky, forward, refine
from ._problem import QP, active_bounds, constraint_scales
from ._search import SearchResult, is_optimal


class RowFactor(NamedTuple):
    """Factors of the KKT system at an active set, in row space."""

    free: Bool[Array, " n"]
    active_rows: Bool[Array, " p"]
    root: Float[Array, " n"]  # of the inverse damping, 0 where not free
    scaled: Float[Array, "m_and_p n"]  # B
    cholesky: Float[Array, "m_and_p m_and_p"]  # L of S = L L'
    contraction: Float[Array, ""]  # the size of a correction relative to the one before it
    is_valid: Bool[Array, ""]


def has_few_rows(qp: QP) -> bool:
    """Return whether the row system is the smaller one (static); ``qp`` has a leading axis of problems."""
    if not isinstance(qp.cost, LeastSquares):
        return False
    _, m, n = qp.cost.matrix.shape
    return m + qp.rows.shape[1] <= MAX_ROW_RATIO * n


def try_row_space(qp: QP, start: SearchResult, tolerance: Float[Array, " B"]) -> SearchResult:
    """Return the answers for correct guesses at less than the cost of a search round, else ``start``.

    Args:
        qp: problems of which ``has_few_rows`` holds, with a leading axis, as on all arguments.
        start: where their search begins, with the guess.
        tolerance: violation that counts as none, relative to the scale of the constraint.
    """
    x, y, is_valid = solve_in_row_space(qp, start.active)
    scales = jax.vmap(constraint_scales)(qp, jax.vmap(lambda one: one.cost.diagonal())(qp), x, y)
    roundoff = Roundoff(*(tolerance[:, None] * a for a in scales))
    optimal = is_valid & jax.vmap(is_optimal)(qp, start, x, y, roundoff)
    end = start._replace(x=x, row_multipliers=y, factorizations=start.factorizations + 1, done=optimal, optimal=optimal)
    return choose(optimal, end, start)


def solve_in_row_space(
    qp: QP, active: Int[Array, "B n_and_p"]
) -> tuple[Float[Array, "B n"], Float[Array, "B p"], Bool[Array, " B"]]:
    """Return the result of ``solve_on_active_set`` and whether it is accurate; arguments have a leading axis."""
    factor = jax.vmap(_factorize)(qp, active)
    target = jax.vmap(active_bounds)(qp, active)
    x, y = jax.vmap(_first_solve)(qp, factor, target)
    root = jnp.sqrt(jax.vmap(lambda one: one.cost.diagonal())(qp))
    limit = jnp.minimum(ROW_SPACE_ACCURACY / factor.contraction, ROW_SPACE_CORRECTION)
    x, y, converged = refine(lambda x, y: jax.vmap(_correction)(qp, factor, target, x, y), x, y, root=root, limit=limit)
    return x, y, factor.is_valid & converged


def _factorize(qp: QP, active: Int[Array, " n_and_p"]) -> RowFactor:
    cost, n = qp.cost, active.shape[0] - qp.rows.shape[0]
    assert isinstance(cost, LeastSquares)
    free, active_rows = active[:n] == INACTIVE, active[n:] != INACTIVE
    # with B = [sqrt(W) A; C] D_F^(-1/2): (D + A'WA)^-1 by Woodbury is D^-1/2 (I - B'(B B' + E)^-1 B) D^-1/2
    root = jnp.where(free, 1.0 / jnp.sqrt(cost.damping), 0.0)
    active_part = jnp.where(active_rows[:, None], qp.rows, 0.0)
    rows = jnp.concatenate([jnp.sqrt(cost.weight)[:, None] * cost.matrix, active_part])
    scaled = rows * root
    # E: 1 for rows of the cost, the compliance for active rows; inactive rows are 0 in B and get a 1
    ones = jnp.concatenate([jnp.ones_like(cost.weight), jnp.where(active_rows, qp.compliance, 1.0)])
    schur = product(scaled, scaled.T) + jnp.diag(ones)
    lower = cholesky(schur)
    eps = float(jnp.finfo(schur.dtype).eps)
    diagonal, m = jnp.diagonal(schur), len(cost.weight)
    # the largest diagonal element is weight / damping of a row, whose roundoff each correction leaves
    contraction = eps * jnp.max(diagonal[:m], initial=1.0)
    pivots_are_large = jnp.all(jnp.diagonal(lower) ** 2 >= ROW_SPACE_PIVOT * eps * diagonal)
    is_valid = pivots_are_large & (contraction <= MAX_CONTRACTION)
    return RowFactor(free, active_rows, root, scaled, lower, contraction, is_valid)


def _solve(
    factor: RowFactor, right: Float[Array, " m_and_p"], downhill: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " m_and_p"]]:
    """Return dx, z with D dx - B'z = downhill and B dx + diag(1, compliance) z = right, B in the units of ``right``."""
    # the damping's own step, then what the rows add to it: z = S^-1 (right - B D^-1/2 downhill)
    scaled_step = factor.root * downhill
    z = backward(factor.cholesky, forward(factor.cholesky, right - apply(factor.scaled, scaled_step)))
    return factor.root * (scaled_step + apply(factor.scaled.T, z)), z


def _first_solve(
    qp: QP, factor: RowFactor, target: Float[Array, " n_and_p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Return x and y, solved for the step from the damping's center, which avoids cancellation."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    n, m = len(factor.free), len(cost.weight)
    x = jnp.where(factor.free, cost.center, target[:n])
    residual = jnp.sqrt(cost.weight) * (cost.target - apply(cost.matrix, x))
    gap = jnp.where(factor.active_rows, target[n:] - apply(qp.rows, x), 0.0)
    # at the center the gradient of the damping is 0, so that the rows' residual is the whole right side
    dx, z = _solve(factor, jnp.concatenate([residual, gap]), jnp.zeros_like(x))
    return x + dx, z[m:]


def _correction(
    qp: QP, factor: RowFactor, target: Float[Array, " n_and_p"], x: Float[Array, " n"], y: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Return corrections of x and y from the residuals of the KKT conditions."""
    n, m = len(x), len(factor.cholesky) - len(y)
    downhill = apply(qp.rows.T, y) - qp.cost.gradient(x)
    gap = jnp.where(factor.active_rows, target[n:] - apply(qp.rows, x) - qp.compliance * y, 0.0)
    dx, z = _solve(factor, jnp.concatenate([jnp.zeros(m, x.dtype), gap]), downhill)
    return dx, z[m:]
