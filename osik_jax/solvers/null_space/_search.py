"""The search of saturation in the null space: which joints are on their bounds, and the largest scale of the motion.

    min |x - target|^2   over   {x: (I - P) x = (I - P)(start + scale motion), lower <= x <= upper}

for the largest scale <= 1 for which there is such an x. A dual active set (D. Goldfarb, A. Idnani, "A numerically
stable dual method for solving strictly convex quadratic programs", Mathematical Programming 27, 1983) on

    x = (I - P)(start + scale motion) + P target + P w,    w: multipliers of the joints that are saturated

from x without bounds: the joint that violates its bound most is put there, and those whose multipliers would take the
wrong sign are released first. Each such step raises the dual cost, so that no set comes back. Where nothing can be
released and the joint depends on the saturated ones, a combination of bounds stands against the motion whatever the
null space does; the scale shrinks to where that combination allows it, and the search goes on from there. So the scale
ends at the largest, as in a linear program: the last combination proves it.

The basic algorithm of Flacco, De Luca and Khatib saturates joints and never releases one; this is the optimal variant.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._rules import custom_jvp
from .._dense import apply, product


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

    def holds(self, x: Float[Array, " n"], scale: Array) -> Bool[Array, ""]:
        """Whether x has the rows of all levels so far where they should be, but for rounding."""
        change = x - self.unsaturated(scale)
        left = jnp.max(jnp.abs(change - apply(self.projector, change)))
        return left <= dependence(x.dtype) * self.size(scale)

    def bound(self, side: Int[Array, " n"]) -> Float[Array, " n"]:
        """The bound that each saturated joint sits on, 0 for the free ones."""
        return jnp.where(side > 0, self.upper, jnp.where(side < 0, self.lower, 0.0))


class Found(NamedTuple):
    """State of the search."""

    scale: Float[Array, ""]
    side: Int[Array, " n"]  # -1 saturated on the lower bound, 1 on the upper, 0 free
    weight: Float[Array, " n"]  # multipliers w, of the joint on its way too
    joint: Int[Array, ""]  # the one on its way to its bound ...
    sign: Int[Array, ""]  # ... -1, 1, or 0 where there is none
    blocked: Bool[Array, ""]  # the scale is less than 1, for ...
    blocker: Int[Array, ""]  # ... this joint is beyond its bound at any larger one ...
    blocking: Int[Array, " n"]  # ... it and these, of the same values as ``side``, leaving it no way out
    fresh: Bool[Array, ""]  # the scale has just changed, so that multipliers may have the wrong sign
    iterations: Int[Array, ""]
    done: Bool[Array, ""]
    failed: Bool[Array, ""]


def search(room: Room, max_iterations: int) -> Found:
    """The saturated joints and the scale; not ``done`` where it was cut short.

    Args:
        room: where x may be.
        max_iterations: cap (static).
    """
    zero, none = jnp.asarray(0), jnp.zeros(room.start.shape, jnp.int32)
    no = jnp.asarray(False)
    one = jnp.ones((), room.start.dtype)
    start = Found(one, none, jnp.zeros_like(room.start), zero, none[0], no, zero, none, no, zero, no, no)

    def body(found: Found) -> Found:
        return _step(room, found)._replace(iterations=found.iterations + 1)

    return jax.lax.while_loop(lambda f: ~f.done & ~f.failed & (f.iterations < max_iterations), body, start)


@custom_jvp
def dual_basis(projector: Float[Array, "n n"], side: Int[Array, " n"]) -> Float[Array, "n n"]:
    """C, the pseudo-inverse of the projector's columns of the saturated joints; its rows of the free ones are 0.

    C' (bound - x) takes the saturated joints to their bounds, by the smallest step in the projector's range.
    """
    order = jnp.argsort(side == 0, stable=True)
    valid = side[order] != 0
    basis, triangle = jnp.linalg.qr(jnp.where(valid, projector[:, order], 0.0))
    eye = jnp.eye(len(side), dtype=projector.dtype)
    both = valid[:, None] & valid[None, :]
    inverse = jax.scipy.linalg.solve_triangular(jnp.where(both, triangle, eye), eye)
    dual = product(jnp.where(both, inverse, 0.0), jnp.where(valid, basis, 0.0).T)
    return jnp.zeros_like(dual).at[order].set(dual)


@dual_basis.defjvp
def _dual_basis_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Any]) -> tuple[Array, Array]:
    """G. H. Golub, V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973, for a matrix of full column rank."""
    projector, side = primals
    dual = dual_basis(projector, side)
    columns, moved = (jnp.where(side != 0, matrix, 0.0) for matrix in (projector, tangents[0]))
    rest = moved.T - product(product(moved.T, columns), dual)
    return dual, product(dual, product(dual.T, rest)) - product(dual, product(moved, dual))


def settle(
    room: Room, scale: Array, side: Int[Array, " n"], dual: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """x with the saturated joints on their bounds (refined once), and their multipliers."""
    held, bound = side != 0, room.bound(side)
    x, weight = room.unsaturated(scale), jnp.zeros_like(bound)
    for _ in range(2):
        step = apply(dual.T, jnp.where(held, bound - x, 0.0))
        x, weight = x + apply(room.projector, step), weight + apply(dual, step)
    return x, weight


def _step(room: Room, found: Found) -> Found:
    """One joint saturated or released, the scale reduced, or the end."""
    dual = dual_basis(room.projector, found.side)
    x, weight = settle(room, found.scale, found.side, dual)
    wrong = found.fresh & (found.side * weight > 0.0)
    cleaned = found._replace(side=jnp.where(wrong, 0, found.side), weight=jnp.zeros_like(weight))
    on_its_way = found.sign != 0
    found = found._replace(
        weight=jnp.where(on_its_way, found.weight, weight),
        fresh=jnp.asarray(False),
    )
    x = jnp.where(on_its_way, room.unsaturated(found.scale) + apply(room.projector, found.weight), x)
    found, excess = _choose(room, found, x, dual)
    moved = _move(room, found, excess, dual)
    return _select(wrong.any(), cleaned, _select(found.done, found, moved))


def _choose(
    room: Room, found: Found, x: Float[Array, " n"], dual: Float[Array, "n n"]
) -> tuple[Found, Float[Array, ""]]:
    """The joint on its way, or the one that is furthest beyond its bound, and how far; none: done."""
    others = found.blocking.at[found.blocker].set(0)
    implied = found.blocked & ((others == 0) | (found.side == others)).all() & (found.blocking != 0)
    beyond = jnp.where((found.side != 0) | implied, 0.0, jnp.maximum(x - room.upper, room.lower - x))
    noise = _NOISE * jnp.finfo(x.dtype).eps * (room.size(found.scale) + apply(jnp.abs(dual).T, jnp.abs(x)))
    joint = jnp.where(found.sign != 0, found.joint, jnp.argmax(beyond - noise))
    sign = jnp.where(found.sign != 0, found.sign, jnp.where(x[joint] > room.upper[joint], 1, -1))
    done = (found.sign == 0) & (beyond[joint] <= noise[joint])
    return found._replace(joint=joint, sign=jnp.where(done, 0, sign), done=done), jnp.maximum(beyond[joint], 0.0)


def _move(room: Room, found: Found, excess: Float[Array, ""], dual: Float[Array, "n n"]) -> Found:
    """Takes the joint towards its bound until it is there or a saturated one lets go; where neither, the scale."""
    joint, sign, side = found.joint, found.sign, found.side
    tiny = dependence(dual.dtype)
    column = room.projector[:, joint]
    shares = apply(dual, column)
    outside = column - apply(room.projector, shares)
    freedom = jnp.sum(outside**2)
    independent = freedom > tiny**2
    arrival = jnp.where(independent, excess / jnp.where(independent, freedom, 1.0), jnp.inf)
    loosens = side * sign * shares
    yields = (side != 0) & (loosens > tiny)
    pressure = jnp.maximum(-side * found.weight, 0.0)
    times = jnp.where(yields, pressure / jnp.where(yields, loosens, 1.0), jnp.inf)
    out = jnp.argmin(times)
    time = jnp.minimum(arrival, times[out])
    stuck = jnp.isinf(time)
    time = jnp.where(stuck, 0.0, time)
    weight = (found.weight + sign * time * shares).at[joint].add(-sign * time)
    arrived = found._replace(side=side.at[joint].set(sign), weight=weight, sign=jnp.zeros_like(sign))
    released = found._replace(side=side.at[out].set(0), weight=weight.at[out].set(0.0))
    moved = _select(arrival <= times[out], arrived, released)
    return _select(stuck, _shrink(room, found, (-shares).at[joint].set(1.0)), moved)


def _shrink(room: Room, found: Found, normal: Float[Array, " n"]) -> Found:
    """The scale at which the joint on its way can be on its bound, with the saturated ones on theirs."""
    blocking = found.side.at[found.joint].set(found.sign)
    scale = blocked_scale(room, blocking, normal)
    return found._replace(
        scale=scale,
        weight=jnp.zeros_like(normal),
        sign=jnp.zeros_like(found.sign),
        blocked=jnp.asarray(True),
        blocker=found.joint,
        blocking=blocking,
        fresh=jnp.asarray(True),
        failed=~(scale < found.scale),
    )


def blocked_scale(room: Room, blocking: Int[Array, " n"], normal: Float[Array, " n"]) -> Float[Array, ""]:
    """The scale that puts joints on their bounds whose combination ``normal`` the null space cannot change."""
    gap = jnp.sum(normal * jnp.where(blocking != 0, room.bound(blocking) - room.start, 0.0))
    rate = jnp.sum(normal * room.motion)
    return jnp.clip(jnp.where(rate != 0.0, gap / jnp.where(rate != 0.0, rate, 1.0), 1.0), 0.0, 1.0)


def dependence(dtype: Any) -> float:
    """Part of a joint's unit vector, in the null space and outside the span of others, under which it depends on them.

    Well above the rounding that the factors of joints as dependent as that amplify, which is eps over this.
    """
    return float(jnp.finfo(dtype).eps) ** 0.4


def _select(condition: Array, yes: Found, no: Found) -> Found:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


_NOISE = 100.0
