"""The search of saturation in the null space: which joints are on their bounds, and the largest scale of the motion.

    min 1/2 |x - target|^2   over   x = start + scale motion + P u,   lower <= x <= upper

for the largest scale <= 1 for which there is such an x: a linear program, and below its optimum a QP. As one strictly
convex QP it has a price on what is missing of the motion, so high that nothing else counts beside it:

    min 1/2 |x - target|^2 + 1/2 |motion|^2 (1 - scale)^2 / price

With multipliers y of the joints that are at a bound, its optimality conditions are

    x = x(scale 1) + (P + price m m') y,   m = motion / |motion|,   1 - scale = -price m . y / |motion|

so that the projector itself, and one product of vectors, is the tableau of a dual active set (``_pivots``): nothing is
factored, and where x without bounds is inside them, nothing is searched. The search starts there, puts joints on their
bounds and releases those that push no longer.

The active set is then solved without the price. Where the multipliers are as large as the price is high, their share
``normal`` is a combination of places that the null space does not change,

    normal . x = constant + rate scale,     normal >= 0 at lower bounds, <= 0 at upper ones,

which proves, for every x in the box, that the scale is no larger than with these joints at their bounds; one of them is
then where the others put it. Otherwise the scale is 1. The tableau, whose block of the saturated joints is nearly the
inverse of the projector's, corrects that answer until it is exact.

The basic algorithm of Flacco, De Luca and Khatib saturates joints and never releases one; this is the optimal variant.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._box import clip_to_box
from .._dense import apply
from .._double import first_smallest
from .._lanes import choose
from .._pivots import AT_UPPER, INACTIVE, Dual, Limits, Noise, begin
from .._pivots import search as change_active_set

_PRICE = 1e-7
"""Of what is missing of the motion: the squared length of x that it outweighs."""
_NOISE = 1e-11
"""Relative to the numbers that x is made of, less than this beyond a bound is none."""
_TILT = 1e-5
"""Share of a combination of joints up to which the null space changes it, and does not count as changing it."""
_MATTERS = 1e-7
"""Joints with a smaller entry in the combination do not stop the motion."""
_ATTEMPTS = 6
"""Where an answer does not hold, the next attempt is with a lower price, and with that part of the motion which is left
near the scale that was found: motions that are too large for their box by orders of magnitude lose digits."""
_ROUNDING = 1e-15
"""Relative to the numbers that x is made of: an answer that is off by less is not corrected."""
_ROUNDS = 5
"""Corrections of the answer; one is the rule."""
_HOLDS = 2e-9
"""Relative to the numbers that x is made of: what an answer may be off by before it is put on its bounds."""


class Room(NamedTuple):
    """Where x may be: the problem above. The start is in the box, the motion is outside the range of the projector."""

    start: Float[Array, " n"]
    motion: Float[Array, " n"]
    target: Float[Array, " n"]
    projector: Float[Array, "n n"]
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def unsaturated(self, scale: Array) -> Float[Array, " n"]:
        """The answer without bounds."""
        return self.start + scale * self.motion + apply(self.projector, self.target - self.start)

    def size(self, scale: Array) -> Float[Array, ""]:
        """Of the numbers that x is made of."""
        return jnp.max(jnp.abs(self.start) + scale * jnp.abs(self.motion) + jnp.abs(self.target))

    def bound(self, side: Int[Array, " n"]) -> Float[Array, " n"]:
        """The bound that each saturated joint sits on, 0 for the free ones."""
        return jnp.where(side > 0, self.upper, jnp.where(side < 0, self.lower, 0.0))


class Found(NamedTuple):
    """What the search decided, and the answer."""

    x: Float[Array, " n"]  # inside its box
    scale: Float[Array, ""]
    side: Int[Array, " n"]  # -1 saturated on the lower bound, 1 on the upper, 0 free
    blocking: Int[Array, " n"]  # the joints that stop the motion, at their sides; none where the scale is 1
    blocker: Int[Array, ""]  # the one of them that is free, for the others say where it is
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def search(room: Room, max_iterations: int) -> Found:
    """The saturated joints, the scale and the answer; not ``done`` where it was cut short.

    Args:
        room: where x may be; every array has a leading axis, the batch.
        max_iterations: cap (static).
    """
    count = len(room.start)
    nothing, none = jnp.zeros(room.start.shape, jnp.int32), jnp.zeros(count, jnp.int32)
    scale = jnp.ones(count, room.start.dtype)
    found = Found(room.start, 0.0 * scale, nothing, nothing, none, none, none > 0)

    def attempt(carry: tuple[Array, Array, Found]) -> tuple[Array, Array, Found]:
        number, reach, before = carry
        price = _PRICE * jnp.where(number % 2 == 1, 0.1, 1.0).astype(reach.dtype)
        found = _attempt(room._replace(motion=reach[:, None] * room.motion), price, ~before.done, max_iterations)
        stopped = (found.blocking != 0).any(-1)
        enough = found.done & (stopped | (reach == 1.0))
        further = jnp.where(found.done, 8.0, 2.0 * jnp.clip(jnp.nan_to_num(found.scale), 1e-3, 0.25))
        found = found._replace(scale=reach * found.scale, iterations=before.iterations + found.iterations, done=enough)
        return number + 1, jnp.minimum(reach * further, 1.0), choose(before.done, before, found)

    def go_on(carry: tuple[Array, Array, Found]) -> Array:
        return (carry[0] < _ATTEMPTS) & ~jnp.all(carry[2].done) & jnp.any(carry[2].iterations < max_iterations)

    return jax.lax.while_loop(go_on, attempt, (none[0], scale, found))[2]


def _attempt(room: Room, price: Float[Array, ""], searching: Bool[Array, " B"], max_iterations: int) -> Found:
    limits, root, start = jax.vmap(_tableau, (0, None))(room, price)
    none = jnp.zeros(len(root), jnp.int32)
    end = change_active_set(limits, start, searching=searching, iterations=none, max_iterations=max_iterations)
    given = jax.vmap(_active_set)(room, root, end)
    found = jax.vmap(_found)(room, given, _corrected(room, given), end.iterations)
    return found._replace(done=found.done & (end.iterations < max_iterations))


def _tableau(room: Room, price: Float[Array, ""]) -> tuple[Limits, Float[Array, " n"], Dual]:
    unit = _unit(room)
    tableau = room.projector + price * unit[:, None] * unit[None, :]
    own = jnp.diagonal(tableau)
    root = 1.0 / jnp.sqrt(jnp.where(own > 0.0, own, 1.0))
    value = room.unsaturated(jnp.ones((), unit.dtype))
    small = root * _NOISE * room.size(jnp.ones((), unit.dtype))
    limits = Limits(
        lower=room.lower * root,
        upper=room.upper * root,
        equality=jnp.zeros(len(value), bool),
        noise=Noise(small, small),
        scale=jnp.where(own > 0.0, 1.0, 0.0).astype(value.dtype),
    )
    inactive = jnp.full(len(value), INACTIVE, jnp.int32)
    start = begin(tableau * root[:, None] * root[None, :], value * root, jnp.zeros_like(value), inactive)
    return limits, root, start


def _unit(room: Room) -> Float[Array, " n"]:
    """The direction of the motion."""
    length = jnp.sqrt(jnp.sum(room.motion**2))
    return room.motion / jnp.where(length > 0.0, length, 1.0)


class _Set(NamedTuple):
    """An active set, and what it takes to solve it without the price."""

    side: Int[Array, " n"]
    y: Float[Array, " n"]  # multipliers
    inverse: Float[Array, "n n"]  # nearly that of the projector's block of the saturated joints; 0 outside of it
    normal: Float[Array, " n"]  # 0 where nothing stops the motion
    blocking: Int[Array, " n"]
    blocker: Int[Array, ""]


def _active_set(room: Room, root: Float[Array, " n"], end: Dual) -> _Set:
    """The joints at their bounds; where they stop the motion, all but the one that the others determine best."""
    side = jnp.where(end.active == INACTIVE, 0, jnp.where(end.active == AT_UPPER, 1, -1)).astype(jnp.int32)
    held = side != 0
    y = jnp.where(held, end.multiplier * root, 0.0)
    inverse = jnp.where(held[:, None] & held[None, :], end.tableau * root[:, None] * root[None, :], 0.0)
    # what the tableau's block makes of the motion is the one combination that the null space does not change, if any
    share = -apply(inverse, _unit(room))
    largest = jnp.max(jnp.abs(share))
    share = share / jnp.where(largest > 0.0, largest, 1.0)
    share = jnp.where(jnp.abs(share) > _MATTERS, share, 0.0)
    stops = (largest > 0.0) & (jnp.max(jnp.abs(apply(room.projector, share))) <= _TILT)
    blocker = first_smallest(-jnp.abs(share))
    out = stops & (jnp.arange(len(share)) == blocker)
    column = inverse[blocker]
    own = column[blocker]
    less = inverse - column[:, None] * column[None, :] / jnp.where(own != 0.0, own, 1.0)
    tops = share[blocker]
    rest = y - y[blocker] * share / jnp.where(tops != 0.0, tops, 1.0)
    return _Set(
        side=jnp.where(out, 0, side),
        y=jnp.where(stops, jnp.where(out, 0.0, rest), y),
        inverse=jnp.where(stops, jnp.where(out[:, None] | out[None, :], 0.0, less), inverse),
        normal=jnp.where(stops, share, 0.0),
        blocking=jnp.where(stops & (share != 0.0), side, 0),
        blocker=blocker,
    )


class _Answer(NamedTuple):
    """Iterate of ``_corrected``."""

    normal: Float[Array, " n"]
    y: Float[Array, " n"]
    scale: Float[Array, ""]
    x: Float[Array, " n"]  # with the rows of all levels where they should be
    off: Float[Array, ""]  # of the saturated joints from their bounds, relative to the size
    tilt: Float[Array, ""]  # part of the normal that the null space changes


def _corrected(room: Room, given: _Set) -> _Answer:
    """The answer with the active set's joints on their bounds; every array has a leading axis, the batch."""

    def body(carry: tuple[Array, _Answer]) -> tuple[Array, _Answer]:
        return carry[0] + 1, jax.vmap(_correct)(room, given, carry[1])

    def go_on(carry: tuple[Array, _Answer]) -> Array:
        return (carry[0] < _ROUNDS) & jnp.any(jnp.maximum(carry[1].off, carry[1].tilt) > _ROUNDING)

    first = jax.vmap(_measured)(room, given, given.normal, given.y)
    return jax.lax.while_loop(go_on, body, (jnp.zeros((), jnp.int32), first))[1]


def _correct(room: Room, given: _Set, answer: _Answer) -> _Answer:
    normal = answer.normal - apply(given.inverse, apply(room.projector, answer.normal))
    y = answer.y + apply(given.inverse, jnp.where(given.side != 0, room.bound(given.side) - answer.x, 0.0))
    return _measured(room, given, normal, y)


def _measured(room: Room, given: _Set, normal: Array, y: Array) -> _Answer:
    stopped = (given.blocking != 0).any()
    side = jnp.where(given.side != 0, given.side, given.blocking)
    scale = jnp.where(stopped, blocked_scale(room, side, normal), 1.0)
    x = room.unsaturated(scale) + apply(room.projector, y)
    off = jnp.max(jnp.abs(jnp.where(given.side != 0, room.bound(given.side) - x, 0.0)))
    tilt = jnp.max(jnp.abs(apply(room.projector, normal)))
    tilt = tilt / jnp.maximum(jnp.max(jnp.abs(normal)), jnp.finfo(x.dtype).tiny)
    return _Answer(normal, y, scale, x, off / jnp.maximum(room.size(scale), jnp.finfo(x.dtype).tiny), tilt)


def _found(room: Room, given: _Set, answer: _Answer, iterations: Array) -> Found:
    side = jnp.where(given.side != 0, given.side, given.blocking)  # the blocker is where it should be but for rounding
    x = clip_to_box(jnp.where(side != 0, room.bound(side), answer.x), room.lower, room.upper)
    off = jnp.max(jnp.abs(x - answer.x))
    return Found(
        x=x,
        scale=answer.scale,
        side=given.side,
        blocking=given.blocking,
        blocker=given.blocker,
        iterations=iterations,
        done=(off <= _HOLDS * room.size(answer.scale)) & jnp.isfinite(answer.x).all(),
    )


def blocked_scale(room: Room, side: Int[Array, " n"], normal: Float[Array, " n"]) -> Float[Array, ""]:
    """The scale that puts joints on their bounds whose combination ``normal`` the null space cannot change."""
    gap = jnp.sum(normal * jnp.where(side != 0, room.bound(side) - room.start, 0.0))
    rate = jnp.sum(normal * room.motion)
    return jnp.clip(jnp.where(rate != 0.0, gap / jnp.where(rate != 0.0, rate, 1.0), 1.0), 0.0, 1.0)
