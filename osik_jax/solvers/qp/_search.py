"""Search for the active set in plain JAX: guess, factor, check; if the check fails, the dual method continues.

The guess is the warm start, or no active bound at all; where it is right, one factorisation is all there is. The answer
always comes from a fresh factorisation at the final active set, never from the tableau that found it.
"""

from __future__ import annotations

from collections.abc import Callable
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
    INFEASIBLE_COMPLIANCE,
    KKT_TOLERANCE,
    MAX_INFEASIBLE,
    MAX_ROUNDS,
    REDUNDANCY_TOL,
    RELAXED,
)
from ...numerics._dense import apply
from .._goldfarb_idnani import Roundoff
from ._kkt_solve import KKTFactor, factorize, solve_on_active_set
from ._problem import QP, constraint_scales, kkt_residual, multiplier_roundoff
from ._projected_gradient import projected_gradient
from ._projected_newton import projected_newton
from ._tableau import find_active_set


class SearchResult(NamedTuple):
    """Result of a search; as an iterate it has a leading axis of problems."""

    x: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " m"]
    redundant: Bool[Array, " m"]  # equalities that the active constraints imply
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]
    optimal: Bool[Array, ""]
    infeasible_ends: Int[Array, ""]  # of the dual method
    cold: Bool[Array, ""]  # the search began with no active bound, or does so again
    used_newton: Bool[Array, ""]  # projected Newton took over from the dual method
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
        redundant=jnp.zeros(guess.shape, bool),
        iterations=zeros,
        factorizations=zeros,
        done=no,
        optimal=no,
        infeasible_ends=zeros,
        cold=jax.vmap(lambda one, start: jnp.all(usable_guess(one, 0 * start) == usable_guess(one, start)))(qp, guess),
        used_newton=no,
        infeasible=no,
        compliance=qp.compliance,
        residual=jnp.zeros_like(tolerance),
    )


def search(
    qp: QP,
    guess: Int[Array, "B m"],
    tolerance: Float[Array, " B"],
    *,
    max_iterations: int,
    by_pivots: bool = True,
) -> SearchResult:
    """Solve a batch: every argument has a leading axis of problems.

    The search is in double precision whatever the data: which bounds are active is yes or no, and a weak damping beside
    heavy rows is below the roundoff of single precision. Without ``by_pivots`` projected Newton follows a wrong guess
    at once, not the dual method: a kernel has tried the latter by then, and it is much of what there is to compile.
    """
    kkt_tol = KKT_TOLERANCE[qp.lower.dtype]
    rounds = partial(_search_rounds, max_iterations=max_iterations, kkt_tol=kkt_tol, by_pivots=by_pivots)
    return in_double(partial(_solve_batch, rounds=rounds, kkt_tol=kkt_tol))(qp, guess, tolerance)


def _solve_batch(
    qp: QP,
    guess: Int[Array, "B m"],
    tolerance: Float[Array, " B"],
    *,
    rounds: Callable[[tuple[QP, Array], SearchResult], SearchResult],
    kkt_tol: float,
) -> SearchResult:
    """Return the answers, or the end of projected gradient steps for problems without one."""
    result = rounds((qp, tolerance), initial_result(qp, guess, tolerance))
    # the certificate: no answer without it, however the search ended
    residual = jax.vmap(kkt_residual)(qp, result.x, result.row_multipliers, result.active)
    result = result._replace(residual=residual, optimal=result.optimal & (residual <= kkt_tol))
    return with_a_few(qp, result, result.optimal | result.infeasible, _fall_back)


def _fall_back(qp: QP, result: SearchResult) -> SearchResult:
    inactive = jax.vmap(usable_guess)(qp, jnp.zeros_like(result.active))
    x, y = jax.vmap(projected_gradient)(qp), jnp.zeros_like(result.row_multipliers)
    residual = jax.vmap(kkt_residual)(qp, x, y, inactive)
    return result._replace(x=x, row_multipliers=y, active=inactive, residual=residual)


def _search_rounds(
    given: tuple[QP, Float[Array, " B"]], start: SearchResult, *, max_iterations: int, kkt_tol: float, by_pivots: bool
) -> SearchResult:
    """Factor, check and search in rounds until all problems are done; projected Newton takes over on failure.

    Where weak dampings are beside heavy rows, the tableau of an active set that is far off may have no correct digit.
    So a search that fails from a guess begins again with no active bound before projected Newton takes over.

    After projected Newton there is one more round, so that its answer is the exact minimiser on its active set, if
    there are digits enough for that.
    """
    qp, tolerance = given
    hessian = jax.vmap(lambda one: one.cost.hessian())(qp)
    newton = partial(_by_newton, kkt_tol=kkt_tol, max_iterations=max_iterations, by_pivots=by_pivots)

    def is_running(state: tuple[SearchResult, Array]) -> Bool[Array, ""]:
        result, rounds = state
        return (rounds <= 2 * MAX_ROUNDS) & ~jnp.all(result.done)

    def body(state: tuple[SearchResult, Array]) -> tuple[SearchResult, Array]:
        result, rounds = state
        result = choose(~result.done, _round(qp, hessian, result, tolerance, max_iterations, by_pivots), result)
        gives_up = (result.infeasible_ends >= MAX_INFEASIBLE) | ((rounds + 1) % MAX_ROUNDS == 0)
        failed = ~(result.done | result.used_newton) & gives_up
        restarts = failed & ~result.cold & by_pivots
        result = choose(restarts, _begun_again(qp, result), result)
        return with_a_few(qp, result, ~failed | restarts, newton), rounds + 1

    return jax.lax.while_loop(is_running, body, (start, jnp.asarray(0)))[0]


def _begun_again(qp: QP, result: SearchResult) -> SearchResult:
    """Return the iterate with no active bound; the counts of changes and factorisations go on."""
    no = jnp.zeros_like(result.redundant)
    inactive = jax.vmap(usable_guess)(qp, no.astype(jnp.int32))
    ends = jnp.zeros_like(result.infeasible_ends)
    return result._replace(active=inactive, redundant=no, infeasible_ends=ends, cold=jnp.ones_like(result.cold))


def _by_newton(qp: QP, result: SearchResult, *, kkt_tol: float, max_iterations: int, by_pivots: bool) -> SearchResult:
    # x on an active set that no pivots have made consistent may be anywhere
    start = jnp.where(jnp.isfinite(result.x), result.x, 0.0) if by_pivots else jnp.zeros_like(result.x)
    end = projected_newton(qp, start, result.iterations, feasibility_tol=kkt_tol, max_iterations=max_iterations)
    largest = jax.vmap(lambda one: jnp.max(apply(one.rows**2, 1.0 / one.cost.diagonal()), initial=0.0))(qp)
    # a minimiser gets one more round; the least violation of infeasible rows is final
    infeasible = end.converged & end.infeasible
    optimal = end.converged & ~end.infeasible
    softened = jnp.maximum(INFEASIBLE_COMPLIANCE[largest.dtype] * largest[:, None], qp.compliance)
    return result._replace(
        x=end.x,
        row_multipliers=end.row_multipliers,
        active=end.active,
        iterations=end.iterations,
        factorizations=result.factorizations + end.iterations - result.iterations,
        done=~optimal,
        optimal=optimal,
        used_newton=jnp.ones_like(optimal),
        infeasible=infeasible,
        compliance=jnp.where(infeasible[:, None], softened, qp.compliance),
    )


class _Minimizers(NamedTuple):
    """Minimisers of a batch on its active sets, and their optimality checks."""

    factor: KKTFactor
    x: Float[Array, "B n"]
    row_multipliers: Float[Array, "B p"]
    roundoff: Roundoff
    optimal: Bool[Array, " B"]
    nearly_optimal: Bool[Array, " B"]  # within relaxed tolerances


def _round(
    qp: QP,
    hessian: Float[Array, "B n n"],
    result: SearchResult,
    tolerance: Float[Array, " B"],
    max_iterations: int,
    by_pivots: bool,
) -> SearchResult:
    """Solve on the active set, check, and run the dual method if the check fails, or end."""
    end = _minimize(qp, hessian, result, tolerance)
    exhausted = result.iterations >= max_iterations
    searching = ~(result.done | end.optimal | exhausted | result.used_newton)
    nearly_optimal = end.nearly_optimal
    if by_pivots:
        by_dual_method = partial(_by_dual_method, qp, hessian, result, end, searching, max_iterations)
        after = jax.lax.cond(jnp.any(searching), lambda: choose(searching, by_dual_method(), result), lambda: result)
    else:
        after = result._replace(infeasible_ends=jnp.where(searching, MAX_INFEASIBLE, result.infeasible_ends))
        nearly_optimal &= end.optimal | result.used_newton
    # an active set that the dual method confirms is accepted with relaxed tolerances: what is left is roundoff
    unchanged = jnp.all(after.active == result.active, 1)
    x, y = end.x, end.row_multipliers
    is_finite = jax.vmap(lambda x, y: jnp.isfinite(x).all() & jnp.isfinite(y).all())(x, y)
    accepted = nearly_optimal & unchanged & is_finite
    failed = after.infeasible_ends >= MAX_INFEASIBLE
    x, y = choose(accepted | ~result.used_newton, (x, y), (result.x, result.row_multipliers))
    no_new_end = after.infeasible_ends == result.infeasible_ends
    return after._replace(
        x=x,
        row_multipliers=y,
        factorizations=result.factorizations + 1,
        done=exhausted | result.used_newton | (accepted & (no_new_end | failed)),
        optimal=accepted | result.used_newton,
    )


def _minimize(
    qp: QP, hessian: Float[Array, "B n n"], result: SearchResult, tolerance: Float[Array, " B"]
) -> _Minimizers:
    """Return the minimisers on the active sets, by fresh factors, checked within roundoff and relaxed tolerances."""
    factor = jax.vmap(factorize)(qp, hessian, result.active)
    x, y = solve_on_active_set(qp, factor, result.active)
    scales = jax.vmap(constraint_scales)(qp, jnp.diagonal(hessian, axis1=1, axis2=2), x, y)
    value, multiplier = (tolerance[:, None] * a for a in scales)
    significant = jax.vmap(multiplier_roundoff)(qp, x, y)
    roundoff = Roundoff(value, jnp.minimum(multiplier, significant))
    optimal = jax.vmap(is_optimal)(qp, result, x, y, roundoff)
    relaxed = RELAXED[hessian.dtype]
    relaxed = Roundoff(relaxed * value, jnp.minimum(relaxed * multiplier, significant))
    nearly_optimal = jax.vmap(is_optimal)(qp, result, x, y, relaxed)
    return _Minimizers(factor, x, y, roundoff, optimal, nearly_optimal)


def _by_dual_method(
    qp: QP,
    hessian: Float[Array, "B n n"],
    result: SearchResult,
    at: _Minimizers,
    searching: Bool[Array, " B"],
    max_iterations: int,
) -> SearchResult:
    """Continue from the minimisers by the dual method, which confirms or changes their active sets, or ends."""
    end = find_active_set(
        *(qp, hessian, at.factor, result.active, at.roundoff, at.x, at.row_multipliers),
        searching=searching,
        iterations=result.iterations,
        max_iterations=max_iterations,
    )
    unchanged = jnp.all(end.active == result.active, 1)
    # from an active set that it confirms though the minimiser is none, it would go nowhere in the next round either
    hopeless = unchanged & (end.infeasible | ~at.nearly_optimal)
    ends = jnp.where(hopeless, MAX_INFEASIBLE, end.infeasible.astype(jnp.int32))
    return result._replace(
        active=end.active,
        redundant=end.redundant,
        iterations=end.iterations,
        infeasible_ends=result.infeasible_ends + ends,
    )


def usable_guess(qp: QP, guess: Int[Array, " m"]) -> Int[Array, " m"]:
    """Return the guess without infinite bounds; equal bounds of the box are active from the start."""
    n = qp.lower.shape[0] - qp.rows.shape[0]
    bound = jnp.where(guess == AT_UPPER, qp.upper, qp.lower)
    at_bound = jnp.where(guess == AT_UPPER, AT_UPPER, AT_LOWER)
    label = jnp.where((guess != INACTIVE) & jnp.isfinite(bound), at_bound, INACTIVE)
    in_box = jnp.arange(len(guess)) < n
    pinned = qp.equality & (in_box | (guess != INACTIVE))
    return jnp.where(pinned, EQUALITY, label).astype(jnp.int32)


def is_optimal(
    qp: QP, result: SearchResult, x: Float[Array, " n"], y: Float[Array, " p"], roundoff: Roundoff
) -> Bool[Array, ""]:
    """Check that the minimiser on the active set is optimal: constraints hold, and multipliers have their signs.

    The arguments are those of ``violated_conditions``.
    """
    return ~jnp.any(violated_conditions(qp, result, x, y, roundoff))


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
    inactive_equality = qp.equality & (active == INACTIVE) & ~result.redundant
    violated = gap > jnp.where(result.redundant, REDUNDANCY_TOL[x.dtype], 1.0) * roundoff.value
    wrong_sign = jnp.where(active == AT_LOWER, -multipliers, jnp.where(active == AT_UPPER, multipliers, -jnp.inf))
    return violated | inactive_equality | (wrong_sign > roundoff.multiplier)


def _gaps(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " m"]:
    """Return the distance of each constraint outside its interval; negative inside."""
    values = jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y])
    return jnp.maximum(qp.lower - values, values - qp.upper)
