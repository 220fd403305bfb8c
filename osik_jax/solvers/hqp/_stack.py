"""The levels of a hierarchy under one shape, so that one program serves them all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._damping import Damping
from .._dense import apply
from .._level import Level


class Layout(NamedTuple):
    """Where the rows of each level stand; all static.

    Hard rows are those that a level may have to leave alone: the box, then the rows of every level that may hold
    inequalities.
    """

    variables: int
    levels: int
    rows: int  # of a level, padded
    counts: tuple[int, ...]  # rows of each level
    level_of_hard: tuple[int, ...]  # of each hard row; -1 for the box
    place_of_row: tuple[tuple[int, ...], ...]  # of each row of each level among the hard rows; their number for none


class Stack(NamedTuple):
    """The numbers of a hierarchy.

    Which rows are equalities is settled once, and not asked of the bounds again: XLA may have computed those twice, in
    two roundings.
    """

    levels: Level  # with a leading axis; rows of zeros without bounds fill up
    damping: Damping  # with a leading axis
    equal: Bool[Array, "L m"]  # rows that are equalities
    hard: Float[Array, "h n"]
    hard_lower: Float[Array, " h"]
    hard_upper: Float[Array, " h"]
    hard_equal: Bool[Array, " h"]


class Task(NamedTuple):
    """One level, as it stands below those that are done."""

    level: Level
    damping: Float[Array, ""]  # of x, part of the level's cost
    given: Damping  # what that came from
    equal: Bool[Array, " m"]  # the level's equalities; their bounds are one number, but for rounding
    matrix: Float[Array, "h n"]  # the hard rows
    lower: Float[Array, " h"]
    upper: Float[Array, " h"]
    free: Bool[Array, " h"]  # to be left alone: neither frozen, nor without bounds, nor of a level to come
    own: Bool[Array, " h"]  # of this level
    soft: Bool[Array, " h"]  # of this level, and no equalities
    place: Int[Array, " m"]  # of the level's rows among the hard ones; h for none
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    x: Float[Array, " n"]  # with the frozen rows at their values, and feasible

    @property
    def length(self) -> Float[Array, " h"]:
        """Euclidean norm of each hard row."""
        return jnp.sqrt(jnp.sum(self.matrix**2, -1))

    @property
    def size(self) -> Float[Array, ""]:
        """Of the longest row of the level's cost, the damping's among them."""
        return jnp.maximum(self.level.size, jnp.sqrt(self.damping))

    def gradient(self, x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, " n"]:
        """Of the level's cost, 1/2 |slack|^2 + 1/2 damping |x|^2."""
        return apply(self.level.matrix.T, slack) + self.damping * x

    def missing(self, x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, ""]:
        """Root of twice the level's cost."""
        return jnp.sqrt(jnp.sum(slack**2) + self.damping * jnp.sum(x**2))

    def spread(self, flags: Bool[Array, " m"]) -> Bool[Array, " h"]:
        """Flags of the level's rows at their places among the hard ones."""
        return jnp.zeros(len(self.lower) + 1, bool).at[self.place].max(flags)[:-1]


def stacked(
    levels: Sequence[Level],
    equal: Sequence[Bool[Array, " m"]],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    pinned: Bool[Array, " n"],
    damping: Damping,
) -> tuple[Layout, Stack]:
    """Layout and numbers of a hierarchy whose weights are multiplied in; which rows, and variables, are equalities."""
    n, m = lower.shape[0], max(level.matrix.shape[0] for level in levels)
    mixed = [level for level in levels if not level.equality]
    first, level_of, places = n, [-1] * n, []
    h = n + sum(level.matrix.shape[0] for level in mixed)
    for k, level in enumerate(levels):
        count = level.matrix.shape[0]
        place = list(range(first, first + count)) if not level.equality else [h] * count
        places.append(tuple(place + [h] * (m - count)))
        if not level.equality:
            first, level_of = first + count, level_of + [k] * count
    counts = tuple(level.matrix.shape[0] for level in levels)
    layout = Layout(n, len(levels), m, counts, tuple(level_of), tuple(places))
    stack = Stack(
        levels=jax.tree.map(lambda *a: jnp.stack(a), *(_padded(level, m) for level in levels)),
        damping=damping,
        equal=jnp.stack([jnp.pad(rows, (0, m - len(rows))) for rows in equal]),
        hard=jnp.concatenate([jnp.eye(n, dtype=lower.dtype), *(level.matrix for level in mixed)]),
        hard_lower=jnp.concatenate([lower, *(level.lower for level in mixed)]),
        hard_upper=jnp.concatenate([upper, *(level.upper for level in mixed)]),
        hard_equal=jnp.concatenate(
            [pinned, *(rows for level, rows in zip(levels, equal, strict=True) if not level.equality)]
        ),
    )
    return layout, stack


def _padded(level: Level, rows: int) -> Level:
    more = rows - level.matrix.shape[0]
    return Level(
        jnp.pad(level.matrix, ((0, more), (0, 0))),
        jnp.pad(level.lower, (0, more), constant_values=-jnp.inf),
        jnp.pad(level.upper, (0, more), constant_values=jnp.inf),
    )
