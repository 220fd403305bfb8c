"""The reverse order: from the lowest level to the highest, each disturbing those before it as little as it can.

F. Flacco, A. De Luca, "A reverse priority approach to multi-task control of redundant robots", IROS 2014:

    v_k = v_{k+1} + T_k (J_k T_k)^+ (b_k - J_k v_{k+1}),    T_k: the last columns of [J_l; ...; J_{k+1}; J_k]^+

So the change of step k is, of all that fulfil level k as nearly as its own J_k allows, the one that moves the rows of
the levels below least, and of these the smallest. The highest level comes last and gets all that J_1 alone can give,
however the others depend on it. The change is computed as such, with one addition: the paper takes the rows of all
levels below together, where a posture, which asks something of every joint, outweighs what stands between it and
level k. Here level k + 1 is moved least, then k + 2 in what that leaves free, and so on; with two levels, or where at
most one of those below has to give way, that is the same. The two highest levels then get what the forward order and a
hierarchical QP give them.

With damping no rank is decided between levels: in the null space N of level k, (N B' B N + damping I)^-1 N B' stands
for (B N)^+, for the levels below in the projector too, which so are kept in the measure of the damping. The answer is
then bounded and smooth wherever each J_k by itself keeps its rank. The part of a damping that is for what a level
cannot meet is large where it is not 0: it acts on motions alone, for in the projector it would hand what a level is to
keep to the levels below that one.

When not to use it: from the third level down the sum of least changes is not the least in all, as it is in the forward
order and in ``solve_hqp``; hard bounds (``_saturation.py``).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._backends import Backend
from .._damping import Damping
from .._dense import apply, product
from .._inverses import regularised_inverse, row_space_and_motion
from ..hqp import Level
from ._problem import Demand


def solve_reverse(
    levels: Sequence[Level],
    secondary: Float[Array, " n"],
    damping: Sequence[Damping],
    rank: Array | float,
    backend: Backend = "jax",
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The answer, and the projector onto what no level asks for. The secondary motion comes first of all."""
    x, eye = secondary, jnp.eye(len(secondary), dtype=secondary.dtype)
    below: list[tuple[Array, Damping]] = []
    for level, own in zip(reversed(levels), reversed(damping), strict=True):
        if not level.matrix.shape[0]:
            continue
        demand = Demand.of(level, x, rank)
        strength = own.constant + own.unmet
        space, motion = row_space_and_motion(demand.rows, demand.wanted, demand.cutoff, strength, backend=backend)
        x = x + _least_disturbing(motion, eye - space, below, rank)
        below.append((demand.rows, own))
    if not below:
        return x, eye
    rows = jnp.concatenate([rows for rows, _ in below])
    nothing = jnp.zeros(len(rows), x.dtype)
    space, _ = row_space_and_motion(rows, nothing, _cutoff(rows, rank), damping[-1].constant, backend=backend)
    return x, eye - space


def _least_disturbing(
    change: Float[Array, " n"],
    free: Float[Array, "n n"],
    below: Sequence[tuple[Array, Damping]],
    rank: Array | float,
) -> Float[Array, " n"]:
    """The change of a level with what its null space can do for the rows below, the highest of them first.

    Each comes with its damping.
    """
    for rows, damping in reversed(below):
        restricted = product(rows, free)
        cutoff = _cutoff(rows, rank)
        whole = regularised_inverse(restricted, cutoff, damping.constant + damping.unmet)
        change = change - apply(free, apply(whole, apply(rows, change)))
        inverse = regularised_inverse(restricted, cutoff, damping.constant)
        free = free - product(free, product(inverse, restricted))
    return change


def _cutoff(rows: Float[Array, "m n"], rank: Array | float) -> Float[Array, ""]:
    return rank * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2))
