"""Search for the active set in plain JAX: guess, factor, check; if the check fails, projected Newton goes on.

The guess is the warm start, or no active bound at all; where it is right, one factorisation is all there is. The answer
comes from a fresh factorisation at the final active set, if there are digits enough for that.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._double import in_double
from ...execution._lanes import choose, with_a_few
from ...numerics._constants import (
    AT_LOWER,
    AT_UPPER,
    EQUALITY,
    INACTIVE,
    KKT_TOLERANCE,
    RELAXED,
    SEARCH_TOLERANCES,
    ZERO_MULTIPLIERS,
)
from ...numerics._dense import apply
from ._kkt_solve import factorize, solve_on_active_set
from ._problem import QP, constraint_scales, in_units, infeasible_compliance, kkt_residual, multiplier_roundoff
from ._projected_gradient import projected_gradient
from ._projected_newton import projected_newton


class Roundoff(NamedTuple):
    """Tolerances below which a violation, or a multiplier of the wrong sign, is roundoff."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


class SearchResult(NamedTuple):
    """Result of a search; as an iterate it has a leading axis of problems."""

    x: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " m"]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]
    optimal: Bool[Array, ""]
    infeasible: Bool[Array, ""]  # proven: no point of the box satisfies the hard rows; x is the least violation
    compliance: Float[Array, " p"]  # of the rows in the problem that ``x`` solves
    residual: Float[Array, ""]  # of the optimality conditions


def initial_result(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"]) -> SearchResult:
    """Return the initial iterate of a search: nothing solved, the usable part of the guess active."""
    batch, n, dtype = guess.shape[0], qp.lower.shape[1] - qp.rows.shape[1], qp.lower.dtype
    zeros, no = jnp.zeros(batch, jnp.int32), jnp.zeros(batch, bool)
    return SearchResult(
        x=jnp.zeros((batch, n), dtype),
        row_multipliers=jnp.zeros(qp.rows.shape[:2], dtype),
        active=jax.vmap(usable_guess)(qp, guess),
        iterations=zeros,
        factorizations=zeros,
        done=no,
        optimal=no,
        infeasible=no,
        compliance=qp.compliance,
        residual=jnp.zeros_like(tolerance),
    )


def search(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, max_iterations: int) -> SearchResult:
    """Solve a batch: every argument has a leading axis of problems.

    The search is in double precision whatever the data: which bounds are active is yes or no, and a weak damping beside
    heavy rows is below the roundoff of single precision.
    """
    kkt_tol = KKT_TOLERANCE[qp.lower.dtype]
    return in_double(partial(_solve_batch, max_iterations=max_iterations, kkt_tol=kkt_tol))(qp, guess, tolerance)


def _solve_batch(
    qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, max_iterations: int, kkt_tol: float
) -> SearchResult:
    """Return the answers, or the end of projected gradient steps for problems without one.

    A search that ends without an answer has another one begin at its end, which asks for less.
    """
    first = _on_active_set(qp, tolerance, initial_result(qp, guess, tolerance), kkt_tol, relaxed=1.0)

    def is_running(state: tuple[SearchResult, Array]) -> Bool[Array, ""]:
        return (state[1] < len(SEARCH_TOLERANCES)) & ~jnp.all(state[0].done)

    def go_on(state: tuple[SearchResult, Array]) -> tuple[SearchResult, Array]:
        result, count = state
        tol, zero = jnp.array(SEARCH_TOLERANCES)[count] * kkt_tol, jnp.array(ZERO_MULTIPLIERS)[count]
        newton = partial(_by_newton, feasibility_tol=tol, zero=zero, kkt_tol=kkt_tol, max_iterations=max_iterations)
        return with_a_few((qp, tolerance), result, result.done, newton), count + 1

    result = jax.lax.while_loop(is_running, go_on, (first, jnp.asarray(0)))[0]
    return with_a_few(qp, result, result.optimal | result.infeasible, _fall_back)


def _fall_back(qp: QP, result: SearchResult) -> SearchResult:
    inactive = jax.vmap(usable_guess)(qp, jnp.zeros_like(result.active))
    x, y = jax.vmap(projected_gradient)(qp), jnp.zeros_like(result.row_multipliers)
    residual = jax.vmap(kkt_residual)(qp, x, y, inactive)
    return result._replace(x=x, row_multipliers=y, active=inactive, residual=residual)


def _by_newton(
    data: tuple[QP, Float[Array, " B"]],
    result: SearchResult,
    *,
    feasibility_tol: Float[Array, ""],
    zero: Float[Array, ""],
    kkt_tol: float,
    max_iterations: int,
) -> SearchResult:
    """Return the end of projected Newton, or the exact minimiser on its active set, where that is optimal."""
    qp, tolerance = data
    # in units in which the cost has a curvature of 1 along each variable
    unit = 1.0 / jnp.sqrt(jax.vmap(lambda one: one.cost.diagonal())(qp))
    start = jnp.where(jnp.isfinite(result.x), result.x, 0.0) / unit
    scaled = jax.vmap(in_units)(qp, unit)
    end = projected_newton(scaled, start, result.iterations, feasibility_tol, zero, max_iterations)
    infeasible, optimal = end.converged & end.infeasible, end.converged & ~end.infeasible
    found = result._replace(
        x=end.x * unit,
        row_multipliers=end.row_multipliers,
        active=end.active,
        iterations=end.iterations,
        factorizations=result.factorizations + end.iterations - result.iterations,
        optimal=optimal,
        infeasible=infeasible,
        compliance=jnp.where(infeasible[:, None], jax.vmap(infeasible_compliance)(qp), qp.compliance),
    )
    # the multipliers of the least violation are those of its compliance, for derivatives
    softened = jax.vmap(lambda one, compliance: replace(one, compliance=compliance))(qp, found.compliance)
    factors = jax.vmap(factorize)(softened, jax.vmap(lambda one: one.cost.hessian())(qp), found.active)
    y = solve_on_active_set(softened, factors, found.active)[1]
    of_least = infeasible[:, None] & jnp.isfinite(y)
    found = _judged(
        qp, found._replace(row_multipliers=jnp.where(of_least, y, found.row_multipliers)), 10.0 * feasibility_tol
    )
    exact = _on_active_set(qp, tolerance, found._replace(active=end.determined), kkt_tol, relaxed=RELAXED[unit.dtype])
    exact = choose(optimal & exact.optimal, exact, found)
    return exact._replace(done=exact.done | (end.iterations >= max_iterations))


def _on_active_set(
    qp: QP, tolerance: Float[Array, " B"], result: SearchResult, kkt_tol: float, *, relaxed: float
) -> SearchResult:
    """Return the minimisers on the active sets, by fresh factors; optimal within ``relaxed`` times the tolerances."""
    hessian = jax.vmap(lambda one: one.cost.hessian())(qp)
    x, y = solve_on_active_set(qp, jax.vmap(factorize)(qp, hessian, result.active), result.active)
    scales = jax.vmap(constraint_scales)(qp, jnp.diagonal(hessian, axis1=1, axis2=2), x, y)
    value, multiplier = (relaxed * tolerance[:, None] * a for a in scales)
    roundoff = Roundoff(value, jnp.minimum(multiplier, jax.vmap(multiplier_roundoff)(qp, x, y)))
    wrong = jax.vmap(violated_conditions)(qp, result, x, y, roundoff)
    finite = jnp.isfinite(jnp.concatenate([x, y], 1)).all(1)
    factorizations = result.factorizations + 1
    found = result._replace(x=x, row_multipliers=y, factorizations=factorizations, optimal=finite & ~wrong.any(1))
    return _judged(qp, found, kkt_tol)


def _judged(qp: QP, result: SearchResult, kkt_tol: float | Array) -> SearchResult:
    """Return the result with its residual; there is no answer without this certificate, however it was found."""
    residual = jax.vmap(kkt_residual)(qp, result.x, result.row_multipliers, result.active)
    optimal = result.optimal & (residual <= kkt_tol)
    return result._replace(residual=residual, optimal=optimal, done=optimal | result.infeasible)


def usable_guess(qp: QP, guess: Int[Array, " m"]) -> Int[Array, " m"]:
    """Return the guess without infinite bounds; equal bounds of the box are active from the start."""
    n = qp.lower.shape[0] - qp.rows.shape[0]
    bound = jnp.where(guess == AT_UPPER, qp.upper, qp.lower)
    at_bound = jnp.where(guess == AT_UPPER, AT_UPPER, AT_LOWER)
    label = jnp.where((guess != INACTIVE) & jnp.isfinite(bound), at_bound, INACTIVE)
    in_box = jnp.arange(len(guess)) < n
    pinned = qp.equality & (in_box | (guess != INACTIVE))
    return jnp.where(pinned, EQUALITY, label).astype(jnp.int32)


def violated_conditions(
    qp: QP, result: SearchResult, x: Float[Array, " n"], y: Float[Array, " p"], roundoff: Roundoff
) -> Bool[Array, " m"]:
    """Return which constraints are violated, are inactive equalities, or have a multiplier of the wrong sign.

    x is the minimiser on the active set of ``result``, y the multipliers of the rows there; those of the box follow
    from the gradient.
    """
    active = result.active
    gradient = qp.cost.gradient(x) - apply(qp.rows.T, y)
    multipliers = jnp.concatenate([gradient, y])
    # primal feasibility, the equalities, and dual feasibility
    gap = _gaps(qp, x, y)
    inactive_equality = qp.equality & (active == INACTIVE)
    violated = gap > roundoff.value
    wrong_sign = jnp.where(active == AT_LOWER, -multipliers, jnp.where(active == AT_UPPER, multipliers, -jnp.inf))
    return violated | inactive_equality | (wrong_sign > roundoff.multiplier)


def _gaps(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " m"]:
    """Return the distance of each constraint outside its interval; negative inside."""
    values = jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y])
    return jnp.maximum(qp.lower - values, values - qp.upper)
