"""The levels of a projection under one shape, so that one program serves them all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._damping import Damping
from .._dense import apply
from ..hqp import Level


class Rows(NamedTuple):
    """A level, with rows of zeros without bounds to fill up; what a ``Level`` says of its rows.

    Which rows are equalities is settled once, and not asked of the bounds again: XLA may have computed those twice, in
    two roundings.
    """

    matrix: Float[Array, "m n"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    equal: Bool[Array, " m"]

    def distance(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """A x minus the nearest point of its interval; for equalities too, which a clip would split."""
        value = apply(self.matrix, x)
        return value - jnp.where(self.equal, self.lower, jnp.clip(value, self.lower, self.upper))


class Problem(NamedTuple):
    """Levels, weights multiplied in, and a box."""

    rows: Rows  # with a leading axis, the levels; the last has no rows where there is a secondary motion
    damping: Damping  # with a leading axis too
    targets: Float[Array, "L n"]  # what x comes as near to as it may: the secondary motion at last, 0 before
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    rank: Float[Array, ""]


def padded(
    levels: Sequence[Level],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    secondary: Float[Array, " n"] | None,
    damping: Sequence[Damping],
    rank: Array | float,
) -> Problem:
    """One problem, from levels whose weights are multiplied in; the secondary motion is a level without rows."""
    n, dtype = len(lower), lower.dtype
    targets = [jnp.zeros(n, dtype)] * len(levels)
    if secondary is not None:
        nothing = jnp.zeros(0, dtype)
        levels = [*levels, Level(jnp.zeros((0, n), dtype), nothing, nothing)]
        targets, damping = [*targets, secondary], [*damping, jax.tree.map(jnp.zeros_like, damping[0])]
    count = max(1, *(len(level.lower) for level in levels))
    rows = jax.tree.map(lambda *a: jnp.stack(a), *(_filled_up(level, count) for level in levels))
    return Problem(
        rows,
        jax.tree.map(lambda *a: jnp.stack(a), *damping),
        jnp.stack(targets),
        lower,
        upper,
        jnp.asarray(rank, dtype),
    )


def _filled_up(level: Level, count: int) -> Rows:
    more = count - len(level.lower)
    return Rows(
        jnp.pad(level.matrix, ((0, more), (0, 0))),
        jnp.pad(level.lower, (0, more), constant_values=-jnp.inf),
        jnp.pad(level.upper, (0, more), constant_values=jnp.inf),
        jnp.pad(level.equal, (0, more)),
    )


def first_room(problem: Problem) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The point of the box that is nearest to 0, and the projector onto the joints that can move."""
    lower, upper = problem.lower, problem.upper
    equal = lower == upper
    x = jnp.where(lower > 0.0, lower, jnp.where(upper < 0.0, upper, jnp.where(equal, lower, 0.0)))
    return x, jnp.diag(jnp.where(equal, 0.0, 1.0).astype(x.dtype))
