"""Pytrees of a hierarchy: tolerances, working sets and the answer."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...numerics._constants import HARD_ROW_TOL, HIERARCHY_RANK, MULTIPLIER_TOL, STEP_TOL


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
