"""Primal active-set method for one level.

    min 1/2 |dist(A x, [l, u])|^2 + 1/2 damping |x|^2   over   {x: frozen rows keep their values},  hard rows hold

The start is feasible and all iterates stay so. Each iteration takes the least-squares step in the null space of the
frozen and the active rows (rank-revealing QR) and follows it to the first hard row that blocks it, with an exact line
search where a row of the level enters or leaves its interval. Where the step vanishes, the row with the most wrongly
signed multiplier becomes inactive; without one the point is optimal. Where the rank tolerance leaves directions out of
the least-squares step, one step follows the gradient first. After a run of steps of zero length the choices follow the
least index (R. G. Bland, "New finite pivoting rules for the simplex method", 1977), which cannot cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._double import first_smallest
from ...numerics._constants import EXTRA_DAMPING, MAX_STALLED, STATIONARITY_TOL
from ...numerics._dense import apply
from .._box import minimum_along
from ._active_rows import ActiveRows, factor_active_rows, multipliers
from ._problem import LevelProblem, Tolerances
from ._working_set_solve import factor_least_squares, slack_roundoff, wrong_signs


class PrimalState(NamedTuple):
    """Iterate of the primal active-set method."""

    x: Float[Array, " n"]
    active: Int[Array, " h"]  # of each hard row: -1 active at its lower bound, 1 at its upper, 0 inactive
    multiplier: Float[Array, " h"]
    in_cost: Bool[Array, " m"]  # the level's rows that are outside their interval, or equalities
    rank: Int[Array, ""]  # of those, within what the active rows leave free
    residual: Float[Array, ""]  # largest component of the projected gradient (stationarity)
    stalled: Int[Array, ""]  # steps of zero length in a row
    tried_weak: Bool[Array, ""]  # a step along directions of weak rows, since a row became active
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def primal_active_set(
    problem: LevelProblem, start: PrimalState, tolerances: Tolerances, max_iterations: int
) -> PrimalState:
    """Minimise the level's cost from a feasible start; return the last iterate, ``done`` where it is the optimum.

    The active rows of the start are independent of each other and of the frozen ones.
    """
    level = problem.level

    def iterate(s: PrimalState) -> PrimalState:
        slack = level.distance(s.x)
        in_cost = (slack != 0.0) | problem.level.equal
        rows = jax.lax.optimization_barrier(factor_active_rows(problem, s.active, tolerances.rank))
        least_squares_step, rank = factor_least_squares(problem, in_cost, rows, tolerances)
        step = apply(problem.projector, least_squares_step(s.x, slack))
        change = jnp.where(in_cost, apply(level.matrix, step), 0.0)
        roundoff = slack_roundoff(problem, s.x, slack, tolerances)
        gradient = problem.gradient(s.x, slack)
        # the step vanishes where it changes the rows by no more than roundoff, or is no descent direction
        is_zero = (problem.root_cost(step, change) <= roundoff) | ~(jnp.sum(gradient * step) < 0.0)
        downhill = -apply(rows.projector, gradient)
        zero_gradient = problem.size * (roundoff + tolerances.multiplier * problem.root_cost(s.x, slack))
        weak = is_zero & ~s.tried_weak & (jnp.max(jnp.abs(downhill)) > STATIONARITY_TOL * zero_gradient)
        weak_step = downhill / jnp.where(weak, EXTRA_DAMPING * problem.size**2 + problem.damping, 1.0)
        released = _release(problem, s, gradient, roundoff * problem.size, rows, tolerances)
        moved = _advance(problem, s, jnp.where(weak, weak_step, step), weak, tolerances)
        out = jax.tree.map(lambda a, b: jnp.where(is_zero & ~weak, a, b), released, moved)
        return out._replace(in_cost=in_cost, rank=rank, iterations=s.iterations + 1)

    def is_running(s: PrimalState) -> Bool[Array, ""]:
        return ~s.done & (s.iterations < max_iterations)

    return jax.lax.while_loop(is_running, iterate, start)


def _release(
    problem: LevelProblem,
    s: PrimalState,
    gradient: Float[Array, " n"],
    roundoff: Float[Array, ""],
    rows: ActiveRows,
    tolerances: Tolerances,
) -> PrimalState:
    """Release the active row with the most wrongly signed multiplier, or declare the optimum if none is wrong."""
    multiplier = multipliers(problem, rows, -apply(problem.projector, gradient))
    wrong = wrong_signs(problem, s.active, multiplier, gradient, roundoff, tolerances)
    force = multiplier * s.active * problem.length
    # after a run of steps of zero length all wrong signs are alike, so that the least index is taken (Bland)
    worst = first_smallest(jnp.where(wrong, jnp.where(s.stalled > MAX_STALLED, 0.0, force), jnp.inf))
    any_wrong = wrong.any()
    return s._replace(
        active=s.active.at[worst].set(jnp.where(any_wrong, 0, s.active[worst])),
        multiplier=multiplier,
        residual=jnp.max(jnp.abs(apply(rows.projector, gradient))),
        done=~any_wrong,
    )


def _advance(
    problem: LevelProblem, s: PrimalState, step: Float[Array, " n"], weak: Bool[Array, ""], tolerances: Tolerances
) -> PrimalState:
    """Follow the step as far as the hard rows and the exact line search allow; a weak one as far as these rows do."""
    level = problem.level
    value, rate = apply(problem.hard, s.x), apply(problem.hard, step)
    # a row whose rate is below the rank tolerance is dependent on active rows and cannot block
    size = jnp.sqrt(jnp.sum(step**2)) * problem.length
    approached = problem.may_block & (s.active == 0) & (jnp.abs(rate) > tolerances.rank * size)
    bound = jnp.where(rate > 0.0, problem.upper, problem.lower)
    safe_rate = jnp.where(approached, rate, 1.0)
    # ratio test: the step length at which each hard row reaches its bound
    ratios = jnp.where(approached, jnp.maximum(jnp.where(approached, bound - value, jnp.inf) / safe_rate, 0.0), jnp.inf)
    longest = jnp.min(ratios, initial=jnp.inf)
    # 1/2 damping |x + t d|^2 has the derivative damping (x'd + t d'd)
    damping_terms = problem.damping * jnp.sum(s.x * step), problem.damping * jnp.sum(step**2)
    values = apply(level.matrix, s.x), apply(level.matrix, step)
    ideal = minimum_along(*values, level.lower, level.upper, 1.0, *damping_terms)
    ideal = jnp.where(weak, 1.0, ideal)
    blocked = longest <= ideal
    length = jnp.minimum(longest, ideal)
    first = first_smallest(ratios)  # the least index among ties
    x = s.x + length * step
    stalled = jnp.where(length * jnp.max(jnp.abs(step)) > 0.0, 0, s.stalled + 1)
    active = s.active.at[first].set(jnp.where(blocked, jnp.where(rate[first] > 0.0, 1, -1), s.active[first]))
    return s._replace(x=x, active=active, stalled=stalled, tried_weak=(s.tried_weak | weak) & ~blocked)
