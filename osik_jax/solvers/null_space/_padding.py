"""Pytrees of a projection: its answer, the rows that take part, and levels padded to one shape for one ``scan``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...numerics._constants import ENTRY_ROUNDOFF
from ...numerics._dense import apply
from .._damping import Damping
from .._level import Level, PaddedLevel


class NullSpaceSolution(eqx.Module):
    """Answer of the projection.

    Attributes:
        x: the answer; with bounds, inside them exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: SOLVED; INFEASIBLE where bounds cross (their middle stands for them);
            NUMERICAL_ERROR where the data are not finite (x is then 0, clipped to its bounds);
            with bounds, MAX_ITERATIONS where the search for the saturated joints was cut short.
        projector: onto the null space of all levels; without bounds, the secondary motion went through it. (n, n)
        scales: of each level, the largest part s of its motion that the bounds allow; 1 without bounds. (k,)
        active: -1 at the lower bound, 1 at the upper, 2 pinned by equal bounds, 0 free. (n,)
        iterations: of the search for the saturated joints, all levels together; 0 without bounds.
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    projector: Float[Array, "n n"]
    scales: Float[Array, " k"]
    active: Int[Array, " n"]
    iterations: Int[Array, ""]


class ActiveTask(NamedTuple):
    """Rows of a level that are active at a point (0 for others), and the error they should remove.

    ``cutoff`` is the smallest pivot of these rows, projected, that is not 0: rows that have less outside the span of
    the longer ones count as dependent.
    """

    rows: Float[Array, "m n"]
    error: Float[Array, " m"]
    cutoff: Float[Array, ""]

    @classmethod
    def at(cls, level: Level | PaddedLevel, x: Float[Array, " n"], rank_tol: Array | float) -> ActiveTask:
        """Return the rows active at x: equalities always, inequalities if x violates them."""
        value, equal = apply(level.matrix, x), level.equal
        # a clip halves its derivative between equal bounds
        error = jnp.where(equal, level.lower, jnp.clip(value, level.lower, level.upper)) - value
        is_active = equal | (error != 0.0)
        rows = jnp.where(is_active[:, None], level.matrix, 0.0)
        return cls(rows, error, rank_tol * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2)))


class Problem(NamedTuple):
    """Levels with weights multiplied in, and the box."""

    levels: PaddedLevel  # with a leading axis; the last has no rows where there is a secondary motion
    damping: Damping  # with a leading axis too
    targets: Float[Array, "L n"]  # the nearest x is taken: the secondary motion in the last level, 0 before
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    rank_tol: Float[Array, ""]


def pad_levels(
    levels: Sequence[Level],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    secondary: Float[Array, " n"] | None,
    damping: Damping,
    rank_tol: Array | float,
) -> Problem:
    """Return the padded problem; a secondary motion is one more level without rows.

    Levels are in the order of priority, weights multiplied in; the damping has an axis of levels. Rows of a relative
    length under ``rank_tol`` count as dependent.
    """
    n, dtype = len(lower), lower.dtype
    targets = [jnp.zeros(n, dtype)] * len(levels)
    if secondary is not None:
        # a level without rows keeps nothing and asks for the motion towards its target
        no_bounds = jnp.zeros(0, dtype)
        levels = [*levels, Level(jnp.zeros((0, n), dtype), no_bounds, no_bounds)]
        targets = [*targets, secondary]
        damping = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros_like(a[:1])]), damping)
    count = max(1, *(len(level.lower) for level in levels))
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *(level.padded(count, level.equal) for level in levels))
    return Problem(
        stacked,
        damping,
        jnp.stack(targets),
        lower,
        upper,
        jnp.asarray(rank_tol, dtype),
    )


def without_roundoff(problem: Problem) -> Problem:
    """Return the problem with row entries set to 0 that are roundoff of the row's largest entry.

    The largest scale of a motion takes what every joint can add, however little: one that does not move the task but
    for rounding would go at its top speed.
    """
    matrix = problem.levels.matrix
    largest = jnp.max(jnp.abs(matrix), axis=-1, keepdims=True)
    is_roundoff = (jnp.abs(matrix) <= ENTRY_ROUNDOFF * jnp.finfo(matrix.dtype).eps * largest) & jnp.isfinite(largest)
    return problem._replace(levels=problem.levels._replace(matrix=jnp.where(is_roundoff, 0.0, matrix)))


def initial_point(problem: Problem) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the point of the box nearest to 0, and the projector onto joints whose bounds differ."""
    lower, upper = problem.lower, problem.upper
    pinned = lower == upper
    x = jnp.where(lower > 0.0, lower, jnp.where(upper < 0.0, upper, jnp.where(pinned, lower, 0.0)))
    return x, jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(x.dtype))
