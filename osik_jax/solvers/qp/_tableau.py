"""The search for the active set of a QP: its tableau, from the factors at the active set where the search begins."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from .._pivots import DEPENDENT, INACTIVE, Dual, Limits, Noise, begin, exchange, search
from ._factor import Factor, half_inverse
from ._problem import QP


def find(
    qp: QP,
    hessian: Float[Array, "B n n"],
    factor: Factor,
    active: Int[Array, "B m"],
    noise: Noise,
    x: Float[Array, "B n"],
    y: Float[Array, "B p"],
    *,
    searching: Bool[Array, " B"],
    iterations: Int[Array, " B"],
    max_iterations: int,
) -> Dual:
    """The active sets of the lanes that search.

    Args:
        qp: the problems; every argument has a leading axis, the lanes.
        hessian: of their costs.
        factor: at ``active``.
        active: where the search begins.
        noise: of their values and multipliers.
        x: the minimisers for ``active``.
        y: their row multipliers.
        searching: lanes to work on.
        iterations: changes of the active set so far.
        max_iterations: cap on the changes of the active set.
    """
    tableau = _tableau(qp, hessian, factor)
    start, limits = jax.vmap(_start)(qp, hessian, tableau, factor.free, active, noise, x, y)
    if qp.rows.shape[1]:
        start, consistent = jax.vmap(_hold_rows)(qp, limits, start, active)
        searching = searching & consistent
    return search(limits, start, searching=searching, iterations=iterations, max_iterations=max_iterations)


def _tableau(qp: QP, hessian: Float[Array, "B n n"], factor: Factor) -> Float[Array, "B m m"]:
    """At the active bounds of the boxes, with no row active."""
    inverse = jax.vmap(_inverse)(factor)
    if qp.rows.shape[1]:
        return jax.vmap(_sweep_with_rows)(qp, hessian, inverse, factor.free)
    return jax.lax.cond(jnp.all(factor.free), lambda: inverse, lambda: jax.vmap(_sweep)(hessian, inverse, factor.free))


def _inverse(factor: Factor) -> Float[Array, "n n"]:
    """Of the Hessian over the free variables, 0 elsewhere."""
    half = half_inverse(factor.lower)
    return jnp.where(factor.free[:, None] & factor.free[None, :], product(half.T, half), 0.0)


def _sweep(whole: Float[Array, "m m"], inverse: Float[Array, "m m"], free: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """The tableau in which the free variables have been exchanged, from their inverse block."""
    forth, back = product(whole, inverse), product(inverse, whole)
    down, across = free[:, None], free[None, :]
    return jnp.where(down, jnp.where(across, inverse, -back), jnp.where(across, forth, whole - product(forth, whole)))


def _sweep_with_rows(
    qp: QP, hessian: Float[Array, "n n"], inverse: Float[Array, "n n"], free: Bool[Array, " n"]
) -> Float[Array, "m m"]:
    p = qp.rows.shape[0]
    whole = jnp.block([[hessian, -qp.rows.T], [qp.rows, jnp.diag(qp.compliance)]])
    return _sweep(whole, jnp.pad(inverse, (0, p)), jnp.pad(free, (0, p)))


def _start(
    qp: QP,
    hessian: Float[Array, "n n"],
    tableau: Float[Array, "m m"],
    free: Bool[Array, " n"],
    active: Int[Array, " m"],
    noise: Noise,
    x: Float[Array, " n"],
    y: Float[Array, " p"],
) -> tuple[Dual, Limits]:
    n = len(x)
    own = jnp.abs(jnp.diagonal(tableau))
    intrinsic = apply(qp.rows**2, 1.0 / jnp.where(jnp.diagonal(hessian) > 0.0, jnp.diagonal(hessian), 1.0))
    scale = jnp.concatenate([own[:n], jnp.maximum(own[n:], intrinsic)])
    root = jnp.sqrt(jnp.where(scale > 0.0, scale, 1.0))
    unit = jnp.concatenate([jnp.where(free, 1.0 / root[:n], root[:n]), 1.0 / root[n:]])
    slope = qp.cost.gradient(x) - apply(qp.rows.T, y)
    limits = Limits(
        lower=qp.lower * unit,
        upper=qp.upper * unit,
        equality=qp.equality,
        noise=Noise(noise.value * unit, noise.multiplier / unit),
        scale=scale / root**2,
    )
    start = begin(
        tableau / root[:, None] / root[None, :],
        jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y]) * unit,
        jnp.where(active == INACTIVE, 0.0, jnp.concatenate([slope, y]) / unit),
        active,
    )
    return start, limits


def _hold_rows(qp: QP, limits: Limits, s: Dual, active: Int[Array, " m"]) -> tuple[Dual, Bool[Array, ""]]:
    """Pivots the active rows in; those that depend on others become inactive, and the state is then not consistent."""
    m, p = len(active), qp.rows.shape[0]
    order = jnp.arange(m)

    def hold(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        tableau, held = state
        k = m - p + j
        fits = tableau[k, k] > DEPENDENT * jnp.finfo(tableau.dtype).eps * limits.scale[k]
        moves = (active[k] != INACTIVE) & fits
        left, right = exchange(tableau, k, held, moves)
        return tableau - left[:, None] * right[None, :], held | ((order == k) & moves)

    in_box = (active != INACTIVE) & (order < m - p)
    tableau, held = jax.lax.fori_loop(0, p, hold, (s.tableau, in_box))
    left_out = (active != INACTIVE) & ~held
    return s._replace(tableau=tableau, active=jnp.where(left_out, INACTIVE, active)), ~left_out.any()
