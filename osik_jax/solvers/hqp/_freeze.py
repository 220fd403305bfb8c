"""Constraints that a level at its optimum freezes for lower levels (docs/dev/derivations.md, "The freezing rule").

Active hard rows with a nonzero multiplier and the level's own rows in its cost have the same values at all minimisers
of the level. They become equalities, and their row space is taken out of the projector.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import ZERO_PIVOT
from ...numerics._dense import apply, product
from .._damping import narrow_box
from ._implicit_diff import ActiveSets
from ._primal_active_set import PrimalState
from ._problem import LevelProblem, Tolerances, WorkingSet
from ._working_set_solve import gradient_roundoff, slack_roundoff


class CascadeState(NamedTuple):
    """State between levels: x, bounds of the hard rows, and the rows frozen so far."""

    x: Float[Array, " n"]
    lower: Float[Array, " h"]  # of the hard rows; those of solved levels are widened to the values reached
    upper: Float[Array, " h"]
    frozen: Bool[Array, " h"]
    active: Int[Array, " h"]  # active and not frozen
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    curvature: Float[Array, " n"]  # bound on the curvature of the rows so far along each variable
    active_bounds: Int[Array, " n"]  # of the box, frozen or not
    residual: Float[Array, ""]  # largest stationarity residual of a level, in units of its gradient's terms
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]


class LevelOutcome(NamedTuple):
    """Reported results of one level."""

    active_sets: ActiveSets
    working_set: WorkingSet
    multipliers: Float[Array, "*B h"]
    slack_norm: Float[Array, "*B"]  # at the level's own optimum


class _Determined(NamedTuple):
    """Common properties of all minimisers of a level."""

    slack: Float[Array, " m"]
    in_cost: Bool[Array, " m"]  # own rows that are equalities or outside their interval
    frozen: Bool[Array, " h"]  # active hard rows with a nonzero multiplier


def freeze(
    state: CascadeState, problem: LevelProblem, end: PrimalState, tolerances: Tolerances
) -> tuple[CascadeState, LevelOutcome]:
    """Freeze the rows that a level determines at its optimum ``end``, and report the level."""
    found = _determined(problem, end, tolerances)
    frozen_count = jnp.sum(found.frozen, dtype=jnp.int32)
    same_cost = jnp.all(found.in_cost == end.in_cost)
    # the rank is known from the level's own factors where these have all the rows that are frozen here
    known_rank = jnp.where(same_cost & jnp.all(found.frozen == (end.active != 0)), frozen_count + end.rank, -1)
    basis, rank = _row_space(_rows_to_freeze(problem, found), problem.projector, known_rank, tolerances.rank)
    # active rows without a multiplier are left out of the derivative, unless the rank of the cost's rows would then
    # be another (a tie)
    tie = same_cost & (rank - frozen_count != end.rank) & (problem.damping == 0.0)
    kept = jnp.where(found.frozen | tie, end.active, 0)
    side = jnp.where(found.in_cost, jnp.where(found.slack > 0.0, 1, -1), 0).astype(jnp.int32)
    active_sets = ActiveSets(
        active=jnp.where(problem.damping > 0.0, end.active, kept),
        frozen=kept,
        in_cost=side,
        rank=jnp.where(tie, end.rank, rank - frozen_count),
    )
    own = jnp.where(problem.level.equal, 2, side).astype(jnp.int32)
    slack_norm = jnp.sqrt(jnp.sum(found.slack**2))
    outcome = LevelOutcome(active_sets, WorkingSet(end.active, own), end.multiplier, slack_norm)
    return _state_below(state, problem, end, found, basis), outcome


def _determined(problem: LevelProblem, end: PrimalState, tolerances: Tolerances) -> _Determined:
    """Return the rows with the same value at all minimisers: rows with a slack and rows with a multiplier."""
    level = problem.level
    slack = level.distance(end.x)
    root_cost = problem.root_cost(end.x, slack)
    # a short row has the roundoff of the longest one
    short = tolerances.multiplier * (level.length * jnp.max(jnp.abs(end.x)) + root_cost)
    slack_tol = jnp.maximum(short, slack_roundoff(problem, end.x, slack, tolerances))
    in_cost = problem.level.equal | (jnp.abs(slack) > slack_tol)
    gradient = problem.gradient(end.x, jnp.where(in_cost, slack, 0.0))
    force = jnp.abs(end.multiplier) * problem.length
    roundoff = gradient_roundoff(problem, end.x, slack, tolerances)
    force_tol = tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) + roundoff
    # a force that the damping alone explains leaves the levels below room on the face that the level has reached
    frozen = (end.active != 0) & (force > force_tol + problem.damping * jnp.sqrt(jnp.sum(end.x**2)))
    return _Determined(slack, in_cost, frozen)


def _rows_to_freeze(problem: LevelProblem, found: _Determined) -> Float[Array, "k n"]:
    """Return the rows that lower levels must not change, so scaled that one rank tolerance fits all.

    Hard rows have unit length; the level's own rows are divided by the length of the longest.
    """
    level, n = problem.level, len(problem.x)
    rows = jnp.argsort(~found.frozen, stable=True)[:n]
    length = jnp.where(found.frozen, problem.length, 1.0)[rows]
    return jnp.concatenate(
        [
            jnp.where(found.frozen[rows], 1.0 / length, 0.0)[:, None] * problem.hard[rows],
            jnp.where(found.in_cost[:, None], level.matrix, 0.0) / jnp.where(level.size > 0.0, level.size, 1.0),
        ]
    )


def _state_below(
    state: CascadeState, problem: LevelProblem, end: PrimalState, found: _Determined, basis: Float[Array, "n k"]
) -> CascadeState:
    """Return the initial state of the next level; ``basis`` spans the newly frozen space."""
    n, reached = len(problem.x), apply(problem.hard, end.x)
    low, high, curvature = narrow_box(
        problem.damping_terms, problem.level, state.curvature, end.x, problem.lower[:n], problem.upper[:n]
    )
    terms = problem.size * jnp.maximum(problem.size * jnp.max(jnp.abs(end.x)), problem.root_cost(end.x, found.slack))
    # the levels below may not make a row of this level worse: its interval is widened to the value reached, no further
    return state._replace(
        x=end.x,
        lower=jnp.where(problem.is_own, jnp.minimum(problem.lower, reached), problem.lower).at[:n].set(low),
        upper=jnp.where(problem.is_own, jnp.maximum(problem.upper, reached), problem.upper).at[:n].set(high),
        frozen=state.frozen | found.frozen | problem.scatter(found.in_cost),
        active=jnp.where(found.frozen, 0, end.active),
        projector=problem.projector - product(basis, basis.T),
        curvature=curvature,
        active_bounds=jnp.where(
            end.active[:n] != 0, end.active[:n], jnp.where(state.frozen[:n], state.active_bounds, 0)
        ),
        residual=jnp.maximum(state.residual, end.residual / jnp.where(terms > 0.0, terms, 1.0)),
        done=state.done & end.done,
    )


def skip(state: CascadeState, problem: LevelProblem) -> tuple[CascadeState, LevelOutcome]:
    """Report a level without remaining freedom, which freezes nothing."""
    inactive, own = jnp.zeros_like(state.active), jnp.zeros(problem.level.lower.shape, jnp.int32)
    active_sets = ActiveSets(inactive, inactive, own, jnp.zeros_like(state.iterations))
    slack_norm = jnp.full_like(state.residual, jnp.inf)  # x does not move any more, so no level below can make it worse
    return state, LevelOutcome(active_sets, WorkingSet(inactive, own), jnp.zeros_like(state.lower), slack_norm)


def _row_space(
    rows: Float[Array, "m n"], projector: Float[Array, "n n"], known_rank: Int[Array, ""], rank_tol: Array | float
) -> tuple[Float[Array, "n k"], Int[Array, ""]]:
    """Return an orthonormal basis of the row space inside the projector's range, and its dimension.

    The rows have unit length at most. Where ``known_rank`` is negative, the dimension is the number of pivots above
    ``rank_tol``. The basis has columns of 0 beyond its dimension.
    """
    basis, triangle, _ = jax.scipy.linalg.qr(product(rows, projector).T, mode="economic", pivoting=True)
    pivots = jnp.abs(jnp.diagonal(triangle))
    known = (jnp.arange(len(pivots)) < known_rank) & (pivots > ZERO_PIVOT * rank_tol)
    keep = jnp.where(known_rank < 0, pivots > rank_tol, known)
    basis = product(projector, jnp.where(keep, basis, 0.0))
    # a column of a small pivot is off the range by roundoff over that pivot; projected, it is orthonormalised again
    # by the Newton-Schulz iteration B <- B (3 I - B' B) / 2, without a factorisation
    for _ in range(2):
        basis = 1.5 * basis - 0.5 * product(basis, product(basis.T, basis))
    return basis, jnp.sum(keep, dtype=jnp.int32)
