"""Minimiser of a level on a given working set, and its optimality conditions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import DAMPED_RANK, WORKING_SET_SOLVES
from ...numerics._dense import apply, product
from .._level import PaddedLevel
from ._active_rows import ActiveRows, drop_dependent, factor_active_rows, multipliers, restoring_step
from ._problem import LevelProblem, Tolerances, WorkingSet


class WorkingSetSolution(NamedTuple):
    """Minimiser of a level's cost on a working set, and whether it is the level's optimum."""

    x: Float[Array, " n"]
    active: Int[Array, " h"]  # the active hard rows without those that depend on others
    multiplier: Float[Array, " h"]
    in_cost: Bool[Array, " m"]  # the level's rows that are in its cost: equalities, and rows taken as violated
    rank: Int[Array, ""]  # of those rows, within what the active rows leave free
    residual: Float[Array, ""]  # largest component of the projected gradient (stationarity)
    feasible: Bool[Array, ""]
    optimal: Bool[Array, ""]


def solve_on_working_set(
    problem: LevelProblem, x: Float[Array, " n"], working_set: WorkingSet, tolerances: Tolerances
) -> WorkingSetSolution:
    """Minimise the level's cost with the working set kept, and check the optimality conditions.

    At x the frozen rows have their values. Directions that neither the working set nor the level determines keep their
    component of x.
    """
    level = problem.level
    rows = factor_active_rows(problem, working_set.hard, tolerances.rank)
    rows = jax.lax.optimization_barrier(rows)  # one LAPACK call after another: see docs/installation.md
    active = drop_dependent(working_set.hard, rows)
    in_cost = working_set.own != 0
    target = jnp.where(in_cost, jnp.where(working_set.own == 1, level.upper, level.lower), 0.0)
    least_squares_step, rank = factor_least_squares(problem, in_cost, rows, tolerances)
    # rounding over small pivots has components outside the frozen rows' null space, so each step is projected
    for _ in range(WORKING_SET_SOLVES):
        x = x + apply(problem.projector, restoring_step(problem, rows, active, x))
        slack = jnp.where(in_cost, apply(level.matrix, x) - target, 0.0)
        x = x + apply(problem.projector, least_squares_step(x, slack))
    slack = jnp.where(in_cost, apply(level.matrix, x) - target, 0.0)
    gradient = problem.gradient(x, slack)
    # stationarity, P (gradient + G' multiplier) = 0: the multiplier is minus the lambda of docs/dev/derivations.md
    multiplier = multipliers(problem, rows, -apply(problem.projector, gradient))
    feasible = _is_feasible(problem, active, x, tolerances) & jnp.isfinite(x).all()
    roundoff = gradient_roundoff(problem, x, slack, tolerances)
    signs = ~jnp.any(wrong_signs(problem, active, multiplier, gradient, roundoff, tolerances))
    return WorkingSetSolution(
        x=x,
        active=active,
        multiplier=multiplier,
        in_cost=in_cost,
        rank=rank,
        residual=jnp.max(jnp.abs(apply(rows.projector, gradient))),
        feasible=feasible,
        optimal=feasible & signs & _is_consistent(level, working_set.own, x, tolerances),
    )


def factor_least_squares(
    problem: LevelProblem, in_cost: Bool[Array, " m"], active_rows: ActiveRows, tolerances: Tolerances
) -> tuple[Callable[[Float[Array, " n"], Float[Array, " m"]], Float[Array, " n"]], Int[Array, ""]]:
    """Factor the least-squares problem of a level within the null space of frozen and active rows.

    With P that null space's projector, C = A P the rows in the cost and ``C' = Q R`` by pivoted QR, the cost ``1/2
    |slack + A d|^2 + 1/2 damping |x + d|^2`` over ``d = Q y - P x`` is a least-squares problem of the size of R: ``[R';
    sqrt(damping) I] y = [C x - slack; 0]``. Without damping ``d = Q y`` with ``R' y = -slack``: the step has no part in
    directions that change no row. Return the function from x and its slack to the minimising step d, and the rank of C.
    """
    level, damping = problem.level, problem.damping
    rows = jnp.where(in_cost[:, None], product(level.matrix, active_rows.projector), 0.0)
    basis, triangle, order = jax.scipy.linalg.qr(rows.T, mode="economic", pivoting=True)
    # pivots are lengths of rows, so they are compared with the longest row of the level; a damped step takes all above
    # roundoff, for a row that only the gradient has would contradict the step where a bound is released
    pivots = jnp.abs(jnp.diagonal(triangle)) / jnp.where(level.size > 0.0, level.size, 1.0)
    keep = pivots > jnp.where(damping > 0.0, DAMPED_RANK, tolerances.rank)
    kept = jnp.where(keep[:, None], triangle, 0.0).T
    # a diagonal of 1 below pivots that are left out makes their component of y 0 and the matrix regular
    damped = jnp.concatenate([kept, jnp.diag(jnp.where(keep, jnp.sqrt(damping), 1.0))])
    left, square = jnp.linalg.qr(jax.lax.optimization_barrier(damped))
    left = left[: kept.shape[0]]

    def step(x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, " n"]:
        # damping is of the whole of x in the space that is free, not of the step alone
        present = jnp.where(damping > 0.0, apply(active_rows.projector, x), 0.0)
        right = apply(rows, present) - slack
        y = jax.scipy.linalg.solve_triangular(square, apply(left.T, right[order]))
        return apply(basis, jnp.where(keep, y, 0.0)) - present

    return step, jnp.sum(pivots > tolerances.rank, dtype=jnp.int32)


def wrong_signs(
    problem: LevelProblem,
    active: Int[Array, " h"],
    multiplier: Float[Array, " h"],
    gradient: Float[Array, " n"],
    roundoff: Float[Array, ""],
    tolerances: Tolerances,
) -> Bool[Array, " h"]:
    """Return which active rows have a multiplier of the wrong sign (they pull x away from their bound).

    Forces multiplier * row length are compared with the multiplier tolerance of the gradient's norm, plus ``roundoff``.
    ``roundoff`` is that of the gradient of the level's cost.
    """
    # a force is positive where it holds x back: at an upper bound (1) downhill points up, at a lower (-1) down
    force = multiplier * active * problem.length
    return (active != 0) & (force < -tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) - roundoff)


def gradient_roundoff(
    problem: LevelProblem, x: Float[Array, " n"], slack: Float[Array, " m"], tolerances: Tolerances
) -> Float[Array, ""]:
    """Return the roundoff of the gradient A' slack: the roundoff of a slack times the longest row."""
    return problem.size * slack_roundoff(problem, x, slack, tolerances)


def slack_roundoff(
    problem: LevelProblem, x: Float[Array, " n"], slack: Float[Array, " m"], tolerances: Tolerances
) -> Float[Array, ""]:
    """Return the roundoff of the level's rows: the step tolerance times the terms that cancel in A x - a."""
    return tolerances.step * (problem.size * jnp.max(jnp.abs(x)) + problem.root_cost(x, slack))


def _is_feasible(
    problem: LevelProblem, active: Int[Array, " h"], x: Float[Array, " n"], tolerances: Tolerances
) -> Bool[Array, ""]:
    """Check that no inactive hard row is violated by more than roundoff."""
    # roundoff of a product: the length of the row times that of x
    value = apply(problem.hard, x)
    violation = jnp.maximum(problem.lower - value, value - problem.upper)
    tolerance = tolerances.feasible * (problem.length * jnp.max(jnp.abs(x)) + jnp.abs(value))
    return ~jnp.any(problem.may_block & (active == 0) & (violation > tolerance))


def _is_consistent(
    level: PaddedLevel, own: Int[Array, " m"], x: Float[Array, " n"], tolerances: Tolerances
) -> Bool[Array, ""]:
    """Check that the rows in the cost are exactly those outside their interval, on the assumed side."""
    value = apply(level.matrix, x)
    tolerance = tolerances.feasible * (level.length * jnp.max(jnp.abs(x)) + jnp.abs(value))
    # a row in the cost is outside on its side; one that is not is inside; an equality is always in it
    below, above = level.lower - value, value - level.upper
    inside = (own == 0) & (jnp.maximum(below, above) <= tolerance)
    outside = ((own == -1) & (below >= -tolerance)) | ((own == 1) & (above >= -tolerance))
    return jnp.all(inside | outside | (own == 2))
