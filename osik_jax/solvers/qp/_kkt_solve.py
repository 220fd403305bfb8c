"""Minimiser for a given active set: one Cholesky factorisation, and iterative refinement of the KKT system.

With the active bounds substituted, F the free variables and C the active rows of compliances E, the conditions are

    H_F dx - C_F' dy = r,    C_F dx + E dy = g.

H_F is factored, and the active rows are eliminated by their Schur complement S = C_F H_F^-1 C_F' + E:

    S dy = g - C_F H_F^-1 r,    dx = H_F^-1 (r + C_F' dy)    (J. Nocedal, S. Wright, "Numerical Optimization", 16.2).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import INACTIVE, KKT_RIDGE, LAST_CORRECTION, MAX_REFINEMENTS, SCHUR_RIDGE
from ...numerics._dense import apply, product
from ._problem import QP, active_bounds


class KKTFactor(NamedTuple):
    """Factors of the KKT system at an active set."""

    free: Bool[Array, " n"]
    active_rows: Bool[Array, " p"]
    cholesky: Float[Array, "n n"]  # L of H_F = L L', the identity for variables that are not free
    inverse_rows: Float[Array, "n p"]  # H_F^-1 C_F'
    schur_inverse_root: Float[Array, "p p"]  # G with S^-1 = G'G


def factorize(qp: QP, hessian: Float[Array, "n n"], active: Int[Array, " n_and_p"]) -> KKTFactor:
    """Factor the KKT system of one problem at an active set: labels of the variables, then of the rows."""
    n, p = hessian.shape[0], qp.rows.shape[0]
    eps = float(jnp.finfo(hessian.dtype).eps)
    free, active_rows = active[:n] == INACTIVE, active[n:] != INACTIVE
    # H_F = L L', with a row and a column of the identity for each variable that is not free
    diagonal = jnp.diagonal(hessian)
    ridge = KKT_RIDGE[hessian.dtype] * eps * jnp.where(diagonal > 0.0, diagonal, jnp.maximum(jnp.max(diagonal), eps))
    square = jnp.where(free[:, None] & free[None, :], hessian, 0.0)
    lower = cholesky(square + jnp.diag(jnp.where(free, ridge, 1.0)))
    rows = jnp.where(active_rows[:, None] & free[None, :], qp.rows, 0.0)
    if not p:
        return KKTFactor(free, active_rows, lower, rows.T, jnp.zeros((0, 0), hessian.dtype))
    # S = C_F H_F^-1 C_F' + E = V'V + E with V = L^-1 C_F'; inactive rows get the identity
    half = forward(lower, rows.T)
    schur = product(half.T, half) + jnp.diag(jnp.where(active_rows, qp.compliance, 0.0))
    diagonal = jnp.diagonal(schur)
    ridge = jnp.where(active_rows, SCHUR_RIDGE * eps * diagonal + jnp.where(diagonal == 0.0, eps, 0.0), 1.0)
    return KKTFactor(free, active_rows, lower, backward(lower, half), inverse_root(cholesky(schur + jnp.diag(ridge))))


def solve_on_active_set(
    qp: QP, factor: KKTFactor, active: Int[Array, "B n_and_p"]
) -> tuple[Float[Array, "B n"], Float[Array, "B p"]]:
    """Return minimisers and row multipliers with active constraints as equalities and inactive ones ignored.

    Every argument has a leading axis of problems; all are refined until the last correction is small in each.
    """
    target = jax.vmap(active_bounds)(qp, active)
    n = factor.free.shape[1]

    def correction(x: Array, y: Array) -> tuple[Array, Array]:
        return jax.vmap(_correction)(qp, factor, target, x, y)

    # variables that are not free are at their bounds from the start, and the corrections leave them there
    x, y = jnp.where(factor.free, 0.0, target[:, :n]), jnp.zeros_like(target[:, n:])
    dx, dy = correction(x, y)
    root = jnp.abs(jnp.diagonal(factor.cholesky, axis1=1, axis2=2))
    return _refine(correction, x + dx, y + dy, root)


def _refine(
    correction: Callable[[Array, Array], tuple[Array, Array]],
    x: Float[Array, "B n"],
    y: Float[Array, "B p"],
    root: Float[Array, "B n"],
) -> tuple[Float[Array, "B n"], Float[Array, "B p"]]:
    """Return x and y, refined until the last correction of each problem is small.

    ``correction`` uses exact residuals. ``root``, of the curvature of each variable, takes the units out of x.
    """
    limit = LAST_CORRECTION[x.dtype]

    def is_running(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        *_, relative, count = state
        return jnp.any(relative > limit) & (count < MAX_REFINEMENTS)

    def again(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, y, _, count = state
        dx, dy = correction(x, y)
        return x + dx, y + dy, jax.vmap(_relative_size)(dx * root, (x + dx) * root), count + 1

    start = (x, y, jnp.full(x.shape[0], jnp.inf, x.dtype), jnp.asarray(0))
    return jax.lax.while_loop(is_running, again, start)[:2]


def _relative_size(dx: Float[Array, " n"], x: Float[Array, " n"]) -> Float[Array, ""]:
    # tiny stands for 0: nothing that moves is infinitely large beside an x of 0
    return jnp.max(jnp.abs(dx)) / jnp.maximum(jnp.max(jnp.abs(x)), jnp.finfo(x.dtype).tiny)


def _correction(
    qp: QP, factor: KKTFactor, target: Float[Array, " n_and_p"], x: Float[Array, " n"], y: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Return corrections of x and y from the residuals of the KKT conditions."""
    downhill = apply(qp.rows.T, y) - qp.cost.gradient(x)
    gap = target[len(x) :] - apply(qp.rows, x) - qp.compliance * y
    return solve_kkt(factor, downhill, gap)


def solve_kkt(
    factor: KKTFactor, downhill: Float[Array, " n"], gap: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Return dx, dy with H dx - C'dy = downhill over the free variables and C dx + E dy = gap over the active rows."""
    # block elimination: dy = S^-1 (gap - C_F H_F^-1 r), dx = H_F^-1 (r + C_F' dy)
    step = backward(factor.cholesky, forward(factor.cholesky, jnp.where(factor.free, downhill, 0.0)))
    if not len(gap):
        return step, gap
    present = apply(factor.inverse_rows.T, jnp.where(factor.free, downhill, 0.0))  # C_F H_F^-1 r
    root = factor.schur_inverse_root
    dy = apply(root.T, apply(root, jnp.where(factor.active_rows, gap - present, 0.0)))
    return step + apply(factor.inverse_rows, dy), dy


def kkt_inverse(
    qp: QP, active: Int[Array, " n_and_p"]
) -> Callable[[Float[Array, " n_and_p"]], Float[Array, " n_and_p"]]:
    """Return a function that solves the KKT system of ``solve_kkt``, from (r, -g) to (dx, dy).

    Fixed variables and inactive rows get 0. It takes one step of iterative refinement, with residuals from A, which
    lose fewer digits than those from A'WA.
    """
    factor = factorize(qp, qp.cost.hessian(), active)
    n = len(factor.free)

    def solve(right: Array) -> Array:
        x, y = jnp.zeros_like(right[:n]), jnp.zeros_like(right[n:])
        # the second pass solves for the residual of the first
        for _ in range(2):
            downhill = right[:n] - qp.cost.hessian_product(x) + apply(qp.rows.T, y)
            gap = -right[n:] - apply(qp.rows, x) - qp.compliance * y
            dx, dy = solve_kkt(factor, downhill, jnp.where(factor.active_rows, gap, 0.0))
            x, y = jnp.where(factor.free, x + dx, 0.0), jnp.where(factor.active_rows, y + dy, 0.0)
        return jnp.concatenate([x, y])

    return solve


def inverse_root(lower: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return G with (L L')^-1 = G'G."""
    return forward(lower, jnp.eye(len(lower), dtype=lower.dtype))


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower triangular L with L L' = matrix; only the lower triangle is read."""
    return jax.lax.linalg.cholesky(matrix, symmetrize_input=False)


def forward(lower: Float[Array, "n n"], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return L^-1 right."""
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True)


def backward(lower: Float[Array, "n n"], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return L'^-1 right."""
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True, trans=1)
