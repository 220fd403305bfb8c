"""Reverse order: from the lowest level to the highest, each changing lower levels as little as possible.

F. Flacco, A. De Luca, "A reverse priority approach to multi-task control of redundant robots", IROS 2014:

    v_k = v_{k+1} + T_k (J_k T_k)^+ (b_k - J_k v_{k+1}),    T_k: the last columns of [J_l; ...; J_{k+1}; J_k]^+

So the change of step k is, of all that meet level k as nearly as its own J_k allows, the one that changes the rows of
the levels below least, and of these the smallest. The highest level comes last and gets all that J_1 alone can give,
however the others depend on it. The change is computed as such, with one addition: the paper takes the rows of all
levels below together, where a posture, which has a row for every joint, outweighs the levels between it and level k.
Here level k + 1 is changed least, then k + 2 in what that leaves free, and so on; with two levels, or where at most one
of those below is changed at all, that is the same. The two highest levels then get what the forward order and a
hierarchical QP give them.

With damping no rank is decided between levels: in the null space N of level k, (N B' B N + damping I)^-1 N B' stands
for (B N)^+, for the levels below in the projector too, which so are kept in the measure of the damping. The answer is
then bounded and smooth wherever each J_k by itself keeps its rank. The part of a damping that is for what a level
cannot meet is large where it is not 0: it acts on motions alone; in the projector it would let lower levels disturb it.

When not to use it: from the third level down, a sum of least changes is not the lexicographic optimum, as the forward
order and ``solve_hqp`` have it; hard bounds (``_saturation.py``).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...execution._backends import Backend
from ...numerics._dense import apply, product
from .._damping import Damping
from .._inverses import regularised_inverse, regularised_space, row_space_and_motion
from ..hqp import Level
from ._problem import ActiveTask


def solve_reverse(
    levels: Sequence[Level],
    secondary: Float[Array, " n"],
    damping: Sequence[Damping],
    rank_tol: Array | float,
    backend: Backend = "jax",
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the answer, and the projector onto the null space of all levels; the secondary motion is applied first.

    Arguments as in ``solve_forward``.
    """
    x, eye = secondary, jnp.eye(len(secondary), dtype=secondary.dtype)
    below: list[tuple[Array, Damping]] = []
    for level, one in zip(reversed(levels), reversed(damping), strict=True):
        if not level.matrix.shape[0]:
            continue
        # the smallest change that meets the level by its own rows, as if it were alone
        task = ActiveTask.at(level, x, rank_tol)
        total = one.constant + one.unmet
        space, motion = row_space_and_motion(task.rows, task.error, task.cutoff, total, backend=backend)
        # what the null space of the level can take back for the levels below
        x = x + _least_change(motion, eye - space, below, rank_tol)
        below.append((task.rows, one))
    if not below:
        return x, eye
    # the null space of all levels at once
    rows = jnp.concatenate([rows for rows, _ in below])
    zeros = jnp.zeros(len(rows), x.dtype)
    space, _ = row_space_and_motion(rows, zeros, _cutoff(rows, rank_tol), damping[-1].constant, backend=backend)
    return x, eye - space


def _least_change(
    change: Float[Array, " n"],
    free: Float[Array, "n n"],
    below: Sequence[tuple[Array, Damping]],
    rank_tol: Array | float,
) -> Float[Array, " n"]:
    """Return the motion of a level that changes the rows of lower levels least, the higher of these first.

    A motion in ``free``, the projector onto the null space of the level, is added to ``change``, the level's motion of
    least norm. ``below`` has rows and damping of the levels below, the lowest first.
    """
    is_projector = jnp.asarray(True)
    for rows, damping in reversed(below):
        restricted = product(rows, free)
        cutoff = _cutoff(rows, rank_tol)
        # with all of the damping for the motion, and its constant part for the projector
        whole = regularised_inverse(restricted, cutoff, damping.constant + damping.unmet)
        change = change - apply(free, apply(whole, apply(rows, change)))
        space = regularised_space(restricted, cutoff, damping.constant)
        # rows that hardly leave others have roundoff outside of ``free``, which must not come into the next one's rank;
        # a projector takes it off on both sides, to the square of it
        is_projector &= damping.constant == 0.0
        free = free - product(free, jnp.where(is_projector, product(space, free), space))
    return change


def _cutoff(rows: Float[Array, "m n"], rank_tol: Array | float) -> Float[Array, ""]:
    return rank_tol * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2))
