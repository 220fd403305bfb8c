"""Saturation in the null space: hard bounds for the projection.

F. Flacco, A. De Luca, O. Khatib, "Motion control of redundant robots under joint constraints: saturation in the null
space", ICRA 2012, and "Control of redundant robots under hard joint constraints: saturation in the null space", IEEE
Transactions on Robotics 31(3), 2015. Level k asks for the motion of eq. 7,

    d = (J_k P_{k-1})^+ (b_k - J_k x_{k-1})

and gets s d: s is the largest scale in [0, 1] for which some x in the box has the rows of the levels above where they
are and its own at J_k (x_{k-1} + s d); x_k is the smallest such x. So a level is met exactly if the box and the levels
above allow, and otherwise the direction of what it still lacks is kept. For the first level and a box around 0 that is
the direction of the task. Two things differ from the papers. They scale b_k itself, also at the lower levels, which may
have no admissible scale and then drops the task whole; what is scaled here always has one. And where a level is scaled
down, the joints that stop it can move no more whatever comes after: they leave the null space of the levels below,
which would otherwise be stopped by them whole.

When not to use it: where half a task along the wrong direction is better than little along the right one, and where
rows are inequalities. One unreachable row scales its whole level down; ``solve_hqp`` misses it by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._box import inside
from .._damping import Damping
from .._dense import product
from .._lanes import in_lanes
from ..hqp import Level
from ._projection import level_motion
from ._search import Found, Room, blocked_scale, dependence, dual_basis, search, settle


class Saturated(NamedTuple):
    """What the levels came to inside the box."""

    x: Float[Array, " n"]
    projector: Float[Array, "n n"]
    scales: Float[Array, " k"]
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def solve_saturated(
    levels: Sequence[Level],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    secondary: Float[Array, " n"] | None,
    damping: Sequence[Damping],
    rank: Array | float,
    max_iterations: int,
) -> Saturated:
    """Level after level; then as near to the secondary motion as they leave room."""
    x = _nearest_to_zero(lower, upper)
    projector = jnp.diag(jnp.where(lower == upper, 0.0, 1.0).astype(x.dtype))
    nowhere = jnp.zeros_like(x)
    fixed = jnp.where(lower == upper, 2, 0)
    ends = []
    for level, own in zip(levels, damping, strict=True):
        motion, projector = level_motion(level, x, projector, own, rank)
        end = _descend(Room(x, motion, nowhere, projector, lower, upper), fixed, max_iterations)
        ends.append(end)
        x, projector, fixed = end.x, end.projector, end.fixed
    if secondary is not None:
        ends.append(_descend(Room(x, nowhere, secondary, projector, lower, upper), fixed, max_iterations))
    return Saturated(
        x=ends[-1].x,
        projector=projector,
        scales=jnp.stack([end.scale for end in ends[: len(levels)]]),
        active=ends[-1].active,
        iterations=jnp.sum(jnp.stack([end.iterations for end in ends])),
        done=jnp.stack([end.done for end in ends]).all(),
    )


def _nearest_to_zero(lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.where(lower > 0.0, lower, jnp.where(upper < 0.0, upper, jnp.where(lower == upper, lower, 0.0)))


class _End(NamedTuple):
    """What one level came to."""

    x: Float[Array, " n"]
    scale: Float[Array, ""]
    projector: Float[Array, "n n"]  # without the joints that can move no more
    fixed: Int[Array, " n"]  # those, at their side; 2 for the pinned ones
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def _descend(room: Room, fixed: Int[Array, " n"], max_iterations: int) -> _End:
    """What the search decides, and from that the answer anew, which is differentiable; the start where it fails."""
    found = in_lanes(jax.vmap(partial(search, max_iterations=max_iterations)))(jax.lax.stop_gradient(room))
    found = jax.lax.stop_gradient(found)
    scale, projector, stopped = _stop(room, found)
    # one factorisation after another: see osik_jax/_runtime.py
    scale, side = jax.lax.optimization_barrier((scale, jnp.where(found.done, found.side, 0)))
    x, _ = settle(room, scale, side, dual_basis(room.projector, side))
    x = inside(jnp.where(side != 0, room.bound(side), x), room.lower, room.upper)
    done = found.done & jax.lax.stop_gradient(room.holds(x, scale))
    fixed = jnp.where((fixed == 0) & stopped & done, found.blocking, fixed)
    return _End(
        x=jnp.where(done, x, room.start),
        scale=jnp.where(done, scale, 0.0),
        projector=projector,
        fixed=fixed,
        active=jnp.where(fixed != 0, fixed, jnp.where(done, side, 0)),
        iterations=found.iterations,
        done=done,
    )


def _stop(room: Room, found: Found) -> tuple[Float[Array, ""], Float[Array, "n n"], Bool[Array, " n"]]:
    """The scale, and the projector without the joints that stop the motion, and which these are.

    The blocker's column of the projector is the sum of the others' with their shares, so that the same combination of
    x does not depend on what the null space does.
    """
    others = found.blocking.at[found.blocker].set(0)
    dual = dual_basis(room.projector, others)
    shares = product(dual, room.projector[:, found.blocker][:, None])[:, 0]
    normal = (-shares).at[found.blocker].set(1.0)
    scale = jnp.where(found.blocked, blocked_scale(room, found.blocking, normal), 1.0)
    matters = jnp.abs(normal) > dependence(normal.dtype)
    stopped = jax.lax.stop_gradient(found.blocked & found.done & (found.blocking != 0) & matters)
    frozen = jnp.where(stopped, others, 0)
    frozen, dual = jax.lax.optimization_barrier((frozen, dual))
    columns = jnp.where(frozen != 0, room.projector, 0.0)
    space = product(columns, dual_basis(room.projector, frozen))
    reduced = room.projector - product(room.projector, product(space, room.projector))
    keep = ~stopped[:, None] & ~stopped[None, :]
    return scale, jnp.where(keep, _purified(reduced), 0.0), stopped


def _purified(projector: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """3 P^2 - 2 P^3 of a symmetric P: eigenvalues at a distance e from 0 or 1 come as near as 3 e^2."""
    projector = 0.5 * (projector + projector.T)
    square = product(projector, projector)
    return 3.0 * square - 2.0 * product(square, projector)
