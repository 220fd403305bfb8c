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

from ..._rules import found as kept
from .._backends import Backend
from .._damping import Damping, room_below
from .._double import in_double
from .._inverses import row_space_and_motion
from .._lanes import in_lanes
from ..hqp import Level
from ._at_fixed_sides import Decision, with_derivative
from ._padded import Problem, Rows, first_room, padded
from ._projection import damped_part, level_motion
from ._search import Found, Room, search

_INDEPENDENT = 1e-6
"""Part of a joint's unit vector in the null space and outside the span of others that stop the level; one has less."""
_AT_BOUND = 1e-9
"""A joint that is off its bound by more is not on it."""


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
    backend: Backend = "jax",
) -> Saturated:
    """Level after level; then as near to the secondary motion as they leave room.

    The levels are solved in double precision whatever the data are, for a joint is on its bound or is not. What was
    decided is then differentiated in the precision of the data.
    """
    problem = padded(levels, lower, upper, secondary, damping, rank)
    descend = in_lanes(in_double(partial(_descend, max_iterations, backend)))
    end = kept(descend(jax.lax.stop_gradient(problem)))
    x, projector, scales = with_derivative((end.x, end.projector, end.scales), end.decisions, problem, backend)
    return Saturated(x, projector, scales[: len(levels)], end.active, end.iterations, end.done)


class _End(NamedTuple):
    """What all levels came to, and what each decided."""

    x: Float[Array, " n"]
    projector: Float[Array, "n n"]
    scales: Float[Array, " L"]
    decisions: Decision  # with a leading axis, the levels
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


class _State(NamedTuple):
    """Where the levels so far ended."""

    x: Float[Array, " n"]
    lower: Float[Array, " n"]  # of the levels to come
    upper: Float[Array, " n"]
    bent: Float[Array, " n"]  # how much each variable bends the rows of these levels
    projector: Float[Array, "n n"]  # without the joints that can move no more
    fixed: Int[Array, " n"]  # those, at their side; 2 for the pinned ones
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def _descend(max_iterations: int, backend: Backend, problem: Problem) -> _End:
    """All levels of a batch; every array has a leading axis, the batch, and then perhaps one of levels."""
    x, projector = jax.vmap(first_room)(problem)
    fixed = jnp.where(problem.lower == problem.upper, 2, 0)
    none = jnp.zeros(len(x), jnp.int32)

    def level(state: _State, each: tuple[Rows, Damping, Array]) -> tuple[_State, tuple[Array, Decision]]:
        room, strength = jax.vmap(partial(_room, backend))(problem, state, *each)
        found = search(room, max_iterations)
        part = jax.vmap(damped_part)(each[0], state.x, found.x, strength, problem.rank)
        after, decision = jax.vmap(partial(_after, backend))(state, room, found, part, *each[:2])
        return after, (jnp.where(found.done, part * found.scale, 0.0), decision)

    start = _State(x, problem.lower, problem.upper, jnp.zeros_like(x), projector, fixed, fixed, none, none == 0)
    across = jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), (problem.rows, problem.damping, problem.targets))
    end, (scales, decisions) = jax.lax.scan(level, start, across)
    scales, decisions = jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), (scales, decisions))
    bound = jnp.where(end.active < 0, problem.lower, problem.upper)
    away = (jnp.abs(end.active) == 1) & (jnp.abs(end.x - bound) > _AT_BOUND * (1.0 + jnp.abs(bound)))
    active = jnp.where(away, 0, end.active)  # at the end of its room, or damped on its way to the bound
    return _End(end.x, end.projector, scales, decisions, active, end.iterations, end.done)


def _room(
    backend: Backend, problem: Problem, state: _State, rows: Rows, damping: Damping, target: Array
) -> tuple[Room, Array]:
    """Where the next x may be, and the damping of the level."""
    motion, projector, strength = level_motion(rows, state.x, state.projector, damping, problem.rank, backend)
    return Room(state.x, motion, target, projector, state.lower, state.upper), strength


def _after(
    backend: Backend, state: _State, room: Room, found: Found, part: Array, rows: Rows, damping: Damping
) -> tuple[_State, Decision]:
    """The start again where the search failed."""
    side, stops = (jnp.where(found.done, sides, 0) for sides in (found.side, found.blocking))
    stopped = jnp.where((stops != 0)[:, None], room.projector, 0.0)
    none = jnp.zeros((), stopped.dtype)
    space, _ = row_space_and_motion(stopped, stopped[:, 0], none + _INDEPENDENT, none, backend=backend)
    keep = (stops == 0)[:, None] & (stops == 0)[None, :]
    fixed = jnp.where(state.fixed == 0, stops, state.fixed)
    x = jnp.where(
        found.done & (part < 1.0), state.x + part * (found.x - state.x), jnp.where(found.done, found.x, state.x)
    )
    lower, upper, bent = room_below(damping, rows, state.bent, x, state.lower, state.upper)
    after = _State(
        x=x,
        lower=lower,
        upper=upper,
        bent=bent,
        projector=jnp.where(keep, room.projector - space, 0.0),
        fixed=fixed,
        active=jnp.where(fixed != 0, fixed, side),
        iterations=state.iterations + found.iterations,
        done=state.done & found.done,
    )
    return after, Decision(found.done, side, stops, found.blocker)
