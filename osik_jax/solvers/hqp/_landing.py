"""The optimum of a level on a given active set, and whether it is the optimum of the level."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from .._level import Level
from ._held import Held, hold, multipliers, restoring_step
from ._problem import Tolerances, WorkingSet
from ._stack import Task

_ROUNDS = 2
"""Corrections against exact residuals, the first solution among them."""


class Landing(NamedTuple):
    """The minimiser of the level's cost with the working set kept, and the verdict on it."""

    x: Float[Array, " n"]
    side: Int[Array, " h"]  # rows really held: those that depend on others are left out
    multiplier: Float[Array, " h"]
    counts: Bool[Array, " m"]  # the level's rows that were taken to miss their interval, or are equalities
    rank: Int[Array, ""]  # of those, within what the held rows leave free
    residual: Float[Array, ""]  # stationarity
    feasible: Bool[Array, ""]
    optimal: Bool[Array, ""]


def land(task: Task, x: Float[Array, " n"], working: WorkingSet, tolerances: Tolerances) -> Landing:
    """From a point with the frozen rows at their values to the minimiser on the working set.

    Args:
        task: the level.
        x: the point; what freedom the working set and the level leave keeps its place there.
        working: rows held, and rows that count.
        tolerances: what counts as zero.
    """
    level = task.level
    held = hold(task, working.hard, tolerances.rank)
    held = jax.lax.optimization_barrier(held)  # one LAPACK call after another: see osik_jax/runtime.py
    side = jnp.zeros_like(working.hard).at[held.rows].set(jnp.where(held.valid, working.hard[held.rows], 0))
    counts = working.own != 0
    goal = jnp.where(counts, jnp.where(working.own == 1, level.upper, level.lower), 0.0)
    descend, rank = least_squares(task, counts, held, tolerances)
    for _ in range(_ROUNDS):
        x = x + apply(task.projector, restoring_step(task, held, side, x))
        x = x + apply(task.projector, descend(x, jnp.where(counts, apply(level.matrix, x) - goal, 0.0)))
    slack = jnp.where(counts, apply(level.matrix, x) - goal, 0.0)
    gradient = task.gradient(x, slack)
    multiplier = multipliers(task, held, -apply(task.projector, gradient))
    feasible = _feasible(task, side, x, tolerances) & jnp.isfinite(x).all()
    signs = ~jnp.any(wrong_signs(task, side, multiplier, gradient, noise(task, x, slack, tolerances), tolerances))
    return Landing(
        x=x,
        side=side,
        multiplier=multiplier,
        counts=counts,
        rank=rank,
        residual=jnp.max(jnp.abs(apply(held.projector, gradient))),
        feasible=feasible,
        optimal=feasible & signs & _consistent(level, working.own, x, tolerances),
    )


def nothing_landed(task: Task) -> Landing:
    """Where the level starts, as a landing that is not the optimum."""
    none = jnp.zeros(task.lower.shape, jnp.int32)
    return Landing(
        x=task.x,
        side=none,
        multiplier=jnp.zeros_like(task.lower),
        counts=jnp.zeros(task.level.lower.shape, bool),
        rank=jnp.asarray(0, jnp.int32),
        residual=jnp.zeros_like(task.x[0]),
        feasible=jnp.asarray(False),
        optimal=jnp.asarray(False),
    )


def least_squares(
    task: Task, counts: Bool[Array, " m"], held: Held, tolerances: Tolerances
) -> tuple[Callable[[Float[Array, " n"], Float[Array, " m"]], Float[Array, " n"]], Int[Array, ""]]:
    """From x and its slack, the step z that makes the level's cost least and moves no held row.

    And the rank of the rows that count among such steps. With C those rows in the null space of the held ones and
    ``C' = Q R`` by pivoted QR, the cost ``|A (x + z) + ...|^2 + damping |x + z|^2`` over ``z = Q y - P x`` is a least
    squares of the size of R: ``[R'; sqrt(damping) I] y = [goal; 0]``. Without damping, what no row moves stays.
    """
    level, damping = task.level, task.damping
    rows = jnp.where(counts[:, None], product(level.matrix, held.projector), 0.0)
    basis, triangle, order = jax.scipy.linalg.qr(rows.T, mode="economic", pivoting=True)
    keep = jnp.abs(jnp.diagonal(triangle)) > tolerances.rank * level.size
    small = jnp.where(keep[:, None], triangle, 0.0).T
    damped = jnp.concatenate([small, jnp.diag(jnp.where(keep, jnp.sqrt(damping), 1.0))])
    left, square = jnp.linalg.qr(jax.lax.optimization_barrier(damped))
    left = left[: small.shape[0]]

    def step(x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, " n"]:
        present = jnp.where(damping > 0.0, apply(held.projector, x), 0.0)
        goal = apply(rows, present) - slack
        y = jax.scipy.linalg.solve_triangular(square, apply(left.T, goal[order]))
        return apply(basis, jnp.where(keep, y, 0.0)) - present

    return step, jnp.sum(keep, dtype=jnp.int32)


def wrong_signs(
    task: Task,
    side: Int[Array, " h"],
    multiplier: Float[Array, " h"],
    gradient: Float[Array, " n"],
    floor: Float[Array, ""],
    tolerances: Tolerances,
) -> Bool[Array, " h"]:
    """Held rows that pull and do not push, by more than rounding."""
    pressure = multiplier * side * task.length
    return (side != 0) & (pressure < -tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) - floor)


def noise(task: Task, x: Float[Array, " n"], slack: Float[Array, " m"], tolerances: Tolerances) -> Float[Array, ""]:
    """Slopes of the level's cost under this are rounding."""
    return task.size * rounding(task, x, slack, tolerances)


def rounding(task: Task, x: Float[Array, " n"], slack: Float[Array, " m"], tolerances: Tolerances) -> Float[Array, ""]:
    """Changes of the level's rows under this are noise."""
    return tolerances.step * (task.size * jnp.max(jnp.abs(x)) + task.missing(x, slack))


def _feasible(task: Task, side: Int[Array, " h"], x: Float[Array, " n"], tolerances: Tolerances) -> Bool[Array, ""]:
    value = apply(task.matrix, x)
    gap = jnp.maximum(task.lower - value, value - task.upper)
    near = tolerances.feasible * (task.length * jnp.max(jnp.abs(x)) + jnp.abs(value))
    return ~jnp.any(task.free & (side == 0) & (gap > near))


def _consistent(level: Level, own: Int[Array, " m"], x: Float[Array, " n"], tolerances: Tolerances) -> Bool[Array, ""]:
    """Whether the rows that count are those that miss their interval, and on that side."""
    value = apply(level.matrix, x)
    near = tolerances.feasible * (level.length * jnp.max(jnp.abs(x)) + jnp.abs(value))
    below, above = level.lower - value, value - level.upper
    held = (own == 0) & (jnp.maximum(below, above) <= near)
    missed = ((own == -1) & (below >= -near)) | ((own == 1) & (above >= -near))
    return jnp.all(held | missed | (own == 2))
