"""Pytrees of a hierarchy: tolerances, working sets, the answer, and levels padded to one shape for one program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import HARD_ROW_TOL, HIERARCHY_RANK, MULTIPLIER_TOL, STEP_TOL
from ...numerics._dense import apply
from .._damping import Damping
from .._level import Level, PaddedLevel


class Tolerances(NamedTuple):
    """Relative tolerances below which a number counts as zero."""

    # part of a row outside the span of others, relative to the row
    rank: Float[Array, ""] | float = HIERARCHY_RANK[jnp.dtype("float64")]
    step: Float[Array, ""] | float = STEP_TOL  # change of the level's rows by a step, relative to their scale
    multiplier: Float[Array, ""] | float = MULTIPLIER_TOL  # multiplier, relative to the level's gradient
    feasible: Float[Array, ""] | float = HARD_ROW_TOL  # violation of a row, relative to its scale


class WorkingSet(NamedTuple):
    """Rows taken as active in a level: 0 inactive, -1 at the lower bound, 1 at the upper, 2 equality."""

    hard: Int[Array, " h"]  # hard rows, active at a bound
    own: Int[Array, " m"]  # the level's own rows that are outside their interval on that side, and so in its cost


class HQPSolution(eqx.Module):
    """Answer of a hierarchy.

    The hard rows are those of the box and then those of every level that may hold inequalities (not
    ``Level.equality``), h of them.

    Attributes:
        x: the answer; inside its box exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: a ``Status`` code.
        iterations: changes of the active sets of all levels together.
        factorizations: systems factored, all levels together.
        kkt_residual: the larger of two numbers without units. One is the largest stationarity residual of a level,
            relative to the terms of its gradient. The other is the largest change of a level's norm by the levels below
            it, relative to the terms of its rows. An answer that is SOLVED has at most 1e-9, or 1e-5 in single
            precision (ten times the rank tolerance).
        active: of the box, -1 at the lower bound, 1 at the upper, 2 equality, 0 free. (n,)
        active_rows: of each level, its rows outside their interval: -1 below it, 1 above, 2 equality; 0 for those
            inside. ((m,), ...)
        multipliers: of each level, the forces of the hard rows, in the units of its weighted cost: the downhill
            direction of the cost, within what the levels above leave free, is their combination with these; positive
            at an upper bound, negative at a lower. (levels, h)
        warm_start: the working sets, for the next problem nearby. A pytree of integers.
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    active: Int[Array, " n"]
    active_rows: tuple[Int[Array, " m"], ...]
    multipliers: Float[Array, "L h"]
    warm_start: WorkingSet


class Layout(NamedTuple):
    """Static sizes of a hierarchy and the index of each row.

    Hard rows are those that a level may have to leave as they are: the box, then the rows of every level that may have
    inequalities.
    """

    variables: int
    levels: int
    rows: int  # of a padded level
    row_counts: tuple[int, ...]  # rows of each level before padding
    level_of_hard: tuple[int, ...]  # level of each hard row; -1 for the box
    hard_of_row: tuple[tuple[int, ...], ...]  # index of each row of each level among the h hard rows; h for none

    @property
    def row_of_hard(self) -> list[int]:
        """Return the index of each hard row (box excluded) among the rows of its level."""
        first = self.variables
        levels = self.level_of_hard[first:]
        return [self.hard_of_row[level].index(q) for q, level in enumerate(levels, first)]


class PaddedHierarchy(NamedTuple):
    """Numbers of a hierarchy, padded."""

    levels: PaddedLevel  # with a leading axis of levels; padding rows are 0 and unbounded
    damping: Damping  # with a leading axis of levels
    hard: Float[Array, "h n"]
    hard_lower: Float[Array, " h"]
    hard_upper: Float[Array, " h"]
    hard_is_equality: Bool[Array, " h"]
    hard_level: Int[Array, " h"]  # level of each hard row; -1 for the box


class LevelProblem(NamedTuple):
    """Problem of one level, to be minimised over the minimisers of the levels above."""

    level: PaddedLevel
    damping: Float[Array, ""]  # delta_k of the cost 1/2 |slack|^2 + 1/2 delta_k |x|^2
    damping_terms: Damping  # the terms from which delta_k was computed
    hard: Float[Array, "h n"]  # the hard rows
    lower: Float[Array, " h"]
    upper: Float[Array, " h"]
    may_block: Bool[Array, " h"]  # hard rows of the box or of levels above that are bounded and not frozen
    is_own: Bool[Array, " h"]  # hard rows that belong to this level
    hard_of_row: Int[Array, " m"]  # index of the level's rows among the hard rows; h for none
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    x: Float[Array, " n"]  # feasible, with the frozen rows at their values

    @property
    def length(self) -> Float[Array, " h"]:
        """Return the Euclidean norm of each hard row."""
        return jnp.sqrt(jnp.sum(self.hard**2, -1))

    @property
    def size(self) -> Float[Array, ""]:
        """Return the norm of the longest row of the level's cost, rows sqrt(damping) I included."""
        return jnp.maximum(self.level.size, jnp.sqrt(self.damping))

    def gradient(self, x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return the gradient A' slack + damping x of the level's cost."""
        return apply(self.level.matrix.T, slack) + self.damping * x

    def root_cost(self, x: Float[Array, " n"], slack: Float[Array, " m"]) -> Float[Array, ""]:
        """Return sqrt(|slack|^2 + damping |x|^2), the root of twice the level's cost."""
        return jnp.sqrt(jnp.sum(slack**2) + self.damping * jnp.sum(x**2))

    def scatter(self, flags: Bool[Array, " m"]) -> Bool[Array, " h"]:
        """Scatter flags of the level's rows to their indices among the hard rows."""
        # the last entry takes the flags of rows that are no hard rows, and is cut off
        return jnp.zeros(len(self.lower) + 1, bool).at[self.hard_of_row].max(flags)[:-1]


def pad_hierarchy(
    levels: Sequence[Level],
    equal: Sequence[Bool[Array, " m"]],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    pinned: Bool[Array, " n"],
    damping: Damping,
) -> tuple[Layout, PaddedHierarchy]:
    """Pad the levels of a hierarchy to the row count of the longest; return the static layout and the numbers.

    Levels are in the order of priority, with their weights multiplied in. Variables whose bounds are one number are
    ``pinned``; the damping's fields have a leading axis of levels.
    """
    n, m = lower.shape[0], max(level.matrix.shape[0] for level in levels)
    # levels of equalities alone bound nothing below them: they are frozen, so they add no hard rows
    mixed = [level for level in levels if not level.equality]
    first, level_of_hard, hard_of_row = n, [-1] * n, []
    h = n + sum(level.matrix.shape[0] for level in mixed)
    for k, level in enumerate(levels):
        count = level.matrix.shape[0]
        indices = list(range(first, first + count)) if not level.equality else [h] * count
        hard_of_row.append(tuple(indices + [h] * (m - count)))
        if not level.equality:
            first, level_of_hard = first + count, level_of_hard + [k] * count
    # padding rows are unbounded: they are never outside their interval, so never in the cost
    row_counts = tuple(level.matrix.shape[0] for level in levels)
    layout = Layout(n, len(levels), m, row_counts, tuple(level_of_hard), tuple(hard_of_row))
    hierarchy = PaddedHierarchy(
        levels=jax.tree.map(
            lambda *a: jnp.stack(a), *(level.padded(m, e) for level, e in zip(levels, equal, strict=True))
        ),
        damping=damping,
        hard=jnp.concatenate([jnp.eye(n, dtype=lower.dtype), *(level.matrix for level in mixed)]),
        hard_lower=jnp.concatenate([lower, *(level.lower for level in mixed)]),
        hard_upper=jnp.concatenate([upper, *(level.upper for level in mixed)]),
        hard_is_equality=jnp.concatenate(
            [pinned, *(rows for level, rows in zip(levels, equal, strict=True) if not level.equality)]
        ),
        hard_level=jnp.array(level_of_hard, jnp.int32),
    )
    return layout, hierarchy
