"""Levels of a projection padded to one shape, so that one ``scan`` runs over all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...numerics._constants import ENTRY_ROUNDOFF
from .._damping import Damping
from .._level import Level, PaddedLevel


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
