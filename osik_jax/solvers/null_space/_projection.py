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

from .._damping import Damping, effective
from .._dense import apply, product
from .._inverses import row_space_and_motion
from ..hqp import Level
from ._padded import Rows
from ._problem import Demand


def solve_forward(
    levels: Sequence[Level], secondary: Float[Array, " n"], damping: Sequence[Damping], rank: Array | float
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The answer, and the projector onto what no level asks for."""
    x, projector = jnp.zeros_like(secondary), jnp.eye(len(secondary), dtype=secondary.dtype)
    for level, own in zip(levels, damping, strict=True):
        motion, projector = level_motion(level, x, projector, own, rank)
        x = x + motion
    return x + apply(projector, secondary), projector


def level_motion(
    level: Level | Rows, x: Float[Array, " n"], projector: Float[Array, "n n"], damping: Damping, rank: Array | float
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """What one level adds to x, and the projector for the next."""
    if not level.matrix.shape[0]:
        return jnp.zeros_like(x), projector
    demand = Demand.of(level, x, rank)
    unbounded = jnp.full_like(x, jnp.inf)
    strength = effective(damping, cast(Level, level), x, projector, -unbounded, unbounded)
    space, motion = row_space_and_motion(product(demand.rows, projector), demand.wanted, demand.cutoff, strength)
    # what rounding adds outside the projector's range, as much more as singular values are small, is taken off again
    return apply(projector, motion), projector - product(projector, product(space, projector))
