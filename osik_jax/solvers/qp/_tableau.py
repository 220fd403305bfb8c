"""Dual active-set method of a QP: its tableau, from the KKT factors at the initial active set."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import DEPENDENCE_TOL, INACTIVE
from ...numerics._dense import apply, product
from .._goldfarb_idnani import (
    Constraints,
    DualState,
    Roundoff,
    dual_active_set,
    initial_state,
    principal_pivot,
)
from ._kkt_solve import KKTFactor, inverse_root
from ._problem import QP


def find_active_set(
    qp: QP,
    hessian: Float[Array, "B n n"],
    factor: KKTFactor,
    active: Int[Array, "B m"],
    roundoff: Roundoff,
    x: Float[Array, "B n"],
    y: Float[Array, "B p"],
    *,
    searching: Bool[Array, " B"],
    iterations: Int[Array, " B"],
    max_iterations: int,
) -> DualState:
    """Find the active sets of a batch by the dual method, from minimisers x and y on ``active`` and KKT factors there.

    Every argument has a leading axis of problems; ``iterations`` has the changes of the active set so far.
    """
    tableau = _tableau(qp, hessian, factor)
    start, constraints = jax.vmap(_scaled_start)(qp, hessian, tableau, factor.free, active, roundoff, x, y)
    if qp.rows.shape[1]:
        start, consistent = jax.vmap(_activate_rows)(qp, constraints, start, active)
        searching = searching & consistent
    return dual_active_set(
        constraints, start, searching=searching, iterations=iterations, max_iterations=max_iterations
    )


def _tableau(qp: QP, hessian: Float[Array, "B n n"], factor: KKTFactor) -> Float[Array, "B m m"]:
    """Return the tableau at the active bounds of the box, without active rows."""
    # pivoting on all free variables at once is what their inverse block is for
    inverse = jax.vmap(_inverse)(factor)
    if qp.rows.shape[1]:
        return jax.vmap(_sweep_with_rows)(qp, hessian, inverse, factor.free)
    return jax.lax.cond(jnp.all(factor.free), lambda: inverse, lambda: jax.vmap(_sweep)(hessian, inverse, factor.free))


def _inverse(factor: KKTFactor) -> Float[Array, "n n"]:
    """Return the inverse of the Hessian over the free variables, 0 elsewhere."""
    root = inverse_root(factor.cholesky)
    return jnp.where(factor.free[:, None] & factor.free[None, :], product(root.T, root), 0.0)


def _sweep(matrix: Float[Array, "m m"], inverse: Float[Array, "m m"], free: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """Return the block principal pivot of a matrix M on the free variables F, from their inverse block.

    M_FF becomes M_FF^-1, M_FG -M_FF^-1 M_FG, M_GF M_GF M_FF^-1, and M_GG its Schur complement M_GG - M_GF M_FF^-1 M_FG.
    """
    # the inverse block is 0 outside of F, so that products with it are those with the block
    forth, back = product(matrix, inverse), product(inverse, matrix)
    down, across = free[:, None], free[None, :]
    complement = matrix - product(forth, matrix)
    return jnp.where(down, jnp.where(across, inverse, -back), jnp.where(across, forth, complement))


def _sweep_with_rows(
    qp: QP, hessian: Float[Array, "n n"], inverse: Float[Array, "n n"], free: Bool[Array, " n"]
) -> Float[Array, "m m"]:
    p = qp.rows.shape[0]
    kkt = jnp.block([[hessian, -qp.rows.T], [qp.rows, jnp.diag(qp.compliance)]])
    return _sweep(kkt, jnp.pad(inverse, (0, p)), jnp.pad(free, (0, p)))


def _scaled_start(
    qp: QP,
    hessian: Float[Array, "n n"],
    tableau: Float[Array, "m m"],
    free: Bool[Array, " n"],
    active: Int[Array, " m"],
    roundoff: Roundoff,
    x: Float[Array, " n"],
    y: Float[Array, " p"],
) -> tuple[DualState, Constraints]:
    """Return the start of the search and the constraints, scaled to a tableau diagonal of 1."""
    n = len(x)
    diagonal = jnp.abs(jnp.diagonal(tableau))
    # a row's diagonal element by the diagonal of the Hessian alone, which active bounds do not reduce
    unreduced = apply(qp.rows**2, 1.0 / jnp.where(jnp.diagonal(hessian) > 0.0, jnp.diagonal(hessian), 1.0))
    scale = jnp.concatenate([diagonal[:n], jnp.maximum(diagonal[n:], unreduced)])
    root = jnp.sqrt(jnp.where(scale > 0.0, scale, 1.0))
    # values are multiplied by the unit and multipliers divided; the exchange of an active bound inverts its unit
    unit = jnp.concatenate([jnp.where(free, 1.0 / root[:n], root[:n]), 1.0 / root[n:]])
    gradient = qp.cost.gradient(x) - apply(qp.rows.T, y)
    constraints = Constraints(
        lower=qp.lower * unit,
        upper=qp.upper * unit,
        equality=qp.equality,
        roundoff=Roundoff(roundoff.value * unit, roundoff.multiplier / unit),
        scale=scale / root**2,
    )
    start = initial_state(
        tableau / root[:, None] / root[None, :],
        jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y]) * unit,
        jnp.where(active == INACTIVE, 0.0, jnp.concatenate([gradient, y]) / unit),
        active,
    )
    return start, constraints


def _activate_rows(
    qp: QP, constraints: Constraints, s: DualState, active: Int[Array, " m"]
) -> tuple[DualState, Bool[Array, ""]]:
    """Pivot the active rows in; dependent rows become inactive, which makes the state inconsistent."""
    m, p = len(active), qp.rows.shape[0]
    order = jnp.arange(m)

    def activate(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        tableau, is_active = state
        k = m - p + j
        independent = tableau[k, k] > DEPENDENCE_TOL * jnp.finfo(tableau.dtype).eps * constraints.scale[k]
        moves = (active[k] != INACTIVE) & independent
        left, right = principal_pivot(tableau, k, is_active, moves)
        return tableau - left[:, None] * right[None, :], is_active | ((order == k) & moves)

    in_box = (active != INACTIVE) & (order < m - p)
    tableau, is_active = jax.lax.fori_loop(0, p, activate, (s.tableau, in_box))
    dropped = (active != INACTIVE) & ~is_active
    return s._replace(tableau=tableau, active=jnp.where(dropped, INACTIVE, active)), ~dropped.any()
