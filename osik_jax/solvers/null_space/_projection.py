"""The classical order (eqs. 6 and 7): from the highest level to the lowest, each in the null space of those before it.

    v_k = v_{k-1} + (J_k P_{k-1})^+ (b_k - J_k v_{k-1}),    P_k = P_{k-1} - (J_k P_{k-1})^+ (J_k P_{k-1})

with the Moore-Penrose inverse; rows that depend on others but for a share of the level's own size are left out.
Damping acts on the motion term alone; in the projector it would break idempotency, and lower levels would leak into
higher ones.

When not to use it: where bounds have to hold (``_saturation.py``), or inequalities (``solve_hqp``): an inequality row
takes part only while the levels above it leave it violated, and nothing keeps lower levels from violating it again.
Where a level loses rank against those above it, the levels below jump (``_reverse.py`` does not).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._backends import Backend
from .._damping import Damping, effective, room_below
from .._dense import apply, product
from .._inverses import row_space_and_motion
from ..hqp import Level
from ._padded import Rows
from ._problem import Demand

_WHOLE = 1.0 - 1e-9
"""From this part of a way on it is all of it, but for rounding."""


def solve_forward(
    levels: Sequence[Level],
    secondary: Float[Array, " n"],
    damping: Sequence[Damping],
    rank: Array | float,
    backend: Backend = "jax",
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The answer, and the projector onto what no level asks for."""
    x, projector = jnp.zeros_like(secondary), jnp.eye(len(secondary), dtype=secondary.dtype)
    bent = jnp.zeros_like(x)
    lower, upper = jnp.full_like(x, -jnp.inf), jnp.full_like(x, jnp.inf)
    for level, own in zip(levels, damping, strict=True):
        motion, projector, _ = level_motion(level, x, projector, own, rank, backend)
        x = x + _scale(x, motion, lower, upper) * motion
        lower, upper, bent = room_below(own, level, bent, x, lower, upper)
    motion = apply(projector, secondary)
    return x + _scale(x, motion, lower, upper) * motion, projector


def _scale(
    x: Float[Array, " n"], motion: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Float[Array, ""]:
    """The largest part of a motion, 1 at most, that stays within what levels out of reach leave to those below."""
    moves = motion != 0.0
    gap = jnp.where(motion > 0.0, upper - x, x - lower)
    finite = moves & jnp.isfinite(gap)
    parts = jnp.where(finite, jnp.where(finite, gap, 1.0) / jnp.where(finite, jnp.abs(motion), 1.0), 1.0)
    return jnp.minimum(jnp.min(parts), 1.0)


def level_motion(
    level: Level | Rows,
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
    damping: Damping,
    rank: Array | float,
    backend: Backend = "jax",
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """What one level adds to x, the projector for the next, and the damping that it had."""
    if not level.matrix.shape[0]:
        return jnp.zeros_like(x), projector, jnp.zeros_like(x[0])
    demand = Demand.of(level, x, rank)
    unbounded = jnp.full_like(x, jnp.inf)
    strength = effective(damping, cast(Level, level), x, projector, -unbounded, unbounded)
    restricted = product(demand.rows, projector)
    space, motion = row_space_and_motion(restricted, demand.wanted, demand.cutoff, strength, backend=backend)
    # what rounding adds outside the projector's range, as much more as singular values are small, is taken off again
    return apply(projector, motion), projector - product(projector, product(space, projector)), strength


def damped_part(
    level: Level | Rows,
    start: Float[Array, " n"],
    end: Float[Array, " n"],
    damping: Float[Array, ""],
    rank: Array | float,
) -> Float[Array, ""]:
    """The part of the way from start to end, 1 at most, at which the damped cost of a level is least.

    The motion of a level alone is the damped optimum; the bounds of some joints may ask far more of the others for the
    same motion of the rows, and that is not worth its cost.
    """
    demand = Demand.of(level, start, rank)
    way = end - start
    moved = apply(demand.rows, way)
    cost = jnp.sum(moved**2) + damping * jnp.sum(way**2)
    damped = (damping > 0.0) & (cost > 0.0)
    part = jnp.sum(moved * demand.wanted) / jnp.where(damped, cost, 1.0)
    return jnp.where(damped & (part < _WHOLE), jnp.maximum(part, 0.0), 1.0)
