"""A level by hand: a primal active set on the minimisers of the levels above, where a proposal was not the optimum.

    min 1/2 |dist(A x, [l, u])|^2   over   {x: frozen rows keep their values},  hard rows stay in their intervals

The start is feasible and stays so. Each iteration takes the least-squares step in the null space of what is frozen or
held (rank-revealing QR), and walks to the first hard row that blocks it, with an exact line search where a row of the
level enters or leaves its interval. Where the step vanishes, the most wrongly signed multiplier is dropped; none left
means optimal. After a run of steps of zero length the choices follow the least index (R. G. Bland, "New finite pivoting
rules for the simplex method", 1977), which cannot cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply
from .._double import first_smallest
from ._held import Held, hold, multipliers
from ._landing import least_squares, rounding, wrong_signs
from ._problem import Tolerances
from ._stack import Task

_PATIENCE = 20


class LevelState(NamedTuple):
    """Iterate of one level."""

    x: Float[Array, " n"]
    side: Int[Array, " h"]  # of each hard row: -1 held at its lower bound, 1 at its upper, 0 not held
    multiplier: Float[Array, " h"]
    counts: Bool[Array, " m"]  # the level's rows that miss their interval, or are equalities
    rank: Int[Array, ""]  # of those, within what the held rows leave free
    residual: Float[Array, ""]  # stationarity
    stalled: Int[Array, ""]  # steps of zero length in a row
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def solve_level(task: Task, start: LevelState, tolerances: Tolerances, max_iterations: int) -> LevelState:
    """Minimises the distance of the level's rows to their intervals, from a feasible start.

    Args:
        task: the level.
        start: feasible x, and hard rows held at the start (independent of each other and of the frozen ones).
        tolerances: what counts as zero.
        max_iterations: cap (static).
    """
    level = task.level

    def body(s: LevelState) -> LevelState:
        value = apply(level.matrix, s.x)
        slack = value - jnp.clip(value, level.lower, level.upper)
        counts = (slack != 0.0) | task.equal
        held = jax.lax.optimization_barrier(hold(task, s.side, tolerances.rank))
        descend, rank = least_squares(task, counts, held, tolerances)
        step = apply(task.projector, descend(s.x, slack))
        change = jnp.where(counts, apply(level.matrix, step), 0.0)
        floor = rounding(task, s.x, slack, tolerances)
        gradient = task.gradient(s.x, slack)
        still = (task.missing(step, change) <= floor) | ~(jnp.sum(gradient * step) < 0.0)  # or rounding, not downhill
        at_rest = _drop(task, s, gradient, floor * task.size, held, tolerances)
        moved = _advance(task, s, step, tolerances)
        out = jax.tree.map(lambda a, b: jnp.where(still, a, b), at_rest, moved)
        return out._replace(counts=counts, rank=rank, iterations=s.iterations + 1)

    def go_on(s: LevelState) -> Bool[Array, ""]:
        return ~s.done & (s.iterations < max_iterations)

    return jax.lax.while_loop(go_on, body, start)


def _drop(
    task: Task,
    s: LevelState,
    gradient: Float[Array, " n"],
    floor: Float[Array, ""],
    held: Held,
    tolerances: Tolerances,
) -> LevelState:
    """At rest on the held rows: releases the one with the most wrongly signed multiplier, or declares the optimum."""
    multiplier = multipliers(task, held, -apply(task.projector, gradient))
    wrong = wrong_signs(task, s.side, multiplier, gradient, floor, tolerances)
    pressure = multiplier * s.side * task.length
    worst = first_smallest(jnp.where(wrong, jnp.where(s.stalled > _PATIENCE, 0.0, pressure), jnp.inf))
    release = wrong.any()
    return s._replace(
        side=s.side.at[worst].set(jnp.where(release, 0, s.side[worst])),
        multiplier=multiplier,
        residual=jnp.max(jnp.abs(apply(held.projector, gradient))),
        done=~release,
    )


def _advance(task: Task, s: LevelState, step: Float[Array, " n"], tolerances: Tolerances) -> LevelState:
    """Walks along the step as far as the hard rows and the exact line search allow."""
    level = task.level
    value, rate = apply(task.matrix, s.x), apply(task.matrix, step)
    size = jnp.sqrt(jnp.sum(step**2)) * task.length
    towards = task.free & (s.side == 0) & (jnp.abs(rate) > tolerances.rank * size)
    bound = jnp.where(rate > 0.0, task.upper, task.lower)
    safe = jnp.where(towards, rate, 1.0)
    times = jnp.where(towards, jnp.maximum(jnp.where(towards, bound - value, jnp.inf) / safe, 0.0), jnp.inf)
    limit = jnp.min(times, initial=jnp.inf)
    along = task.damping * jnp.stack([jnp.sum(s.x * step), jnp.sum(step**2)])
    ideal = _line_search(apply(level.matrix, s.x), apply(level.matrix, step), level.lower, level.upper, along)
    blocked = limit <= ideal
    length = jnp.minimum(limit, ideal)
    first = first_smallest(times)  # the least index among ties
    x = s.x + length * step
    stalled = jnp.where(length * jnp.max(jnp.abs(step)) > 0.0, 0, s.stalled + 1)
    side = s.side.at[first].set(jnp.where(blocked, jnp.where(rate[first] > 0.0, 1, -1), s.side[first]))
    return s._replace(x=x, side=side, stalled=stalled)


def _line_search(value: Array, rate: Array, lower: Array, upper: Array, along: Float[Array, "2"]) -> Float[Array, ""]:
    """Exact minimiser t >= 0 of 1/2 |dist(value + t rate, [lower, upper])|^2 + along_0 t + 1/2 along_1 t^2.

    That is a convex piecewise quadratic, along the damping's part of it.
    """
    moving = rate != 0.0
    safe = jnp.where(moving, rate, 1.0)
    ends = [
        jnp.where(moving & jnp.isfinite(b), (jnp.where(jnp.isfinite(b), b, 0.0) - value) / safe, 1.0)
        for b in (lower, upper)
    ]
    knots = jnp.maximum(jnp.concatenate([*ends, jnp.ones(1, value.dtype), jnp.zeros(1, value.dtype)]), 0.0)

    def slope(t: Array) -> Array:
        at = value + t * rate
        return jnp.sum(rate * (at - jnp.clip(at, lower, upper))) + along[0] + t * along[1]

    slopes = jax.vmap(slope)(knots)
    before = jnp.max(jnp.where(slopes < 0.0, knots, 0.0), initial=0.0)
    middle = jnp.min(jnp.where(knots > before, knots, jnp.inf))  # the next knot, where the slope is >= 0
    probe = jnp.where(jnp.isinf(middle), before + 1.0, 0.5 * (before + middle))
    low, high = slope(before), slope(probe)  # linear between knots: extrapolate the secant
    rising = high > low
    best = before - low * (probe - before) / jnp.where(rising, high - low, 1.0)
    return jnp.where(rising, jnp.maximum(best, 0.0), before)
