"""Largest scale of a level's motion in the box, and the joints that saturate there.

    min 1/2 |x - target|^2   over   x = start + scale motion + P u,   lower <= x <= upper

for the largest scale <= 1 for which there is such an x: a linear program, and among its optima a QP. One strictly
convex QP has both, by a quadratic penalty on the missing part of the motion that outweighs all else:

    min 1/2 |x - target|^2 + 1/2 |motion|^2 (1 - scale)^2 / compliance

With multipliers y of the joints that are at a bound, its optimality conditions are

    x = x(scale 1) + (P + compliance m m') y,   m = motion / |motion|,   1 - scale = -compliance m . y / |motion|

so the projector plus one outer product is the tableau of the dual active-set method (``_goldfarb_idnani.py``): nothing
is factored, and where x without bounds is inside them, nothing is searched. The method starts there, saturates joints
and releases those whose multiplier reaches 0.

The active set is then solved without the penalty. Where multipliers are of the order 1 / compliance, their direction
``normal`` is a combination of joints that the null space does not change,

    normal . x = constant + rate scale,     normal >= 0 at lower bounds, <= 0 at upper ones,

which proves (Farkas), for every x in the box, that the scale is no larger than with these joints at their bounds; one
of them is then where the others put it. Otherwise the scale is 1. The tableau's block of the saturated joints is nearly
the inverse of the projector's, and refines that answer until it is exact.

The basic algorithm of Flacco, De Luca and Khatib saturates joints and never releases one; this is their optimal
variant (T-RO 2015).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._double import first_smallest
from ...execution._lanes import choose
from ...numerics._constants import (
    AT_UPPER,
    ATTEMPT_GROWTH,
    ATTEMPT_SCALE,
    INACTIVE,
    INDEPENDENCE_TOL,
    MAX_SATURATION_REFINEMENTS,
    MISSING_COMPLIANCE,
    NEGLIGIBLE_ENTRY,
    PROJECTOR_ROUNDOFF,
    SATURATION_ACCURACY,
    SATURATION_ATTEMPTS,
    SATURATION_RESIDUAL,
    SATURATION_ROUNDOFF,
    STIFFER_COMPLIANCE,
)
from ...numerics._dense import apply
from ...numerics._guarded import quotient
from .._box import clip_to_box
from .._goldfarb_idnani import Constraints, DualState, Roundoff, dual_active_set, initial_state


class ScaledMotion(NamedTuple):
    """Problem data; the start is in the box, the motion outside the range of the projector."""

    start: Float[Array, " n"]
    motion: Float[Array, " n"]
    target: Float[Array, " n"]
    projector: Float[Array, "n n"]
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def unbounded(self, scale: Array) -> Float[Array, " n"]:
        """Return the answer without bounds."""
        return self.start + self.unbounded_step(scale)

    def unbounded_step(self, scale: Array) -> Float[Array, " n"]:
        """Return the step from the start to the answer without bounds."""
        return scale * self.motion + apply(self.projector, self.target - self.start)

    def size(self, scale: Array) -> Float[Array, ""]:
        """Return the magnitude of the terms that add up to x."""
        return jnp.max(jnp.abs(self.start) + scale * jnp.abs(self.motion) + jnp.abs(self.target))

    def bound(self, active: Int[Array, " n"]) -> Float[Array, " n"]:
        """Return the bound of each saturated joint, 0 for other joints."""
        return jnp.where(active > 0, self.upper, jnp.where(active < 0, self.lower, 0.0))


class SaturationResult(NamedTuple):
    """Answer, and the joints that determine it."""

    x: Float[Array, " n"]  # inside its box
    scale: Float[Array, ""]
    active: Int[Array, " n"]  # -1 saturated at the lower bound, 1 at the upper, 0 free
    blocking: Int[Array, " n"]  # the joints that limit the scale, at their bounds; none where the scale is 1
    blocker: Int[Array, ""]  # the one of them that is not in ``active``, for the others determine it
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def solve_scaled_motion(problem: ScaledMotion, max_iterations: int) -> SaturationResult:
    """Return saturated joints, scale and answer of a batch; not ``done`` at the iteration limit.

    Args:
        problem: every array has a leading axis of problems.
        max_iterations: limit on the changes of the active set (static).
    """
    batch = problem.start.shape[0]
    inactive, zeros = jnp.zeros(problem.start.shape, jnp.int32), jnp.zeros(batch, jnp.int32)
    ones = jnp.ones(batch, problem.start.dtype)
    start = SaturationResult(problem.start, 0.0 * ones, inactive, inactive, zeros, zeros, zeros > 0)

    def attempt(carry: tuple[Array, Array, SaturationResult]) -> tuple[Array, Array, SaturationResult]:
        # ``part``: of the motion that this attempt considers
        number, part, before = carry
        # a lower compliance in every other attempt: a stiffer penalty on the missing part
        compliance = MISSING_COMPLIANCE * jnp.where(number % 2 == 1, STIFFER_COMPLIANCE, 1.0).astype(part.dtype)
        partial_motion = problem._replace(motion=part[:, None] * problem.motion)
        result = _attempt(partial_motion, compliance, ~before.done, max_iterations)
        is_blocked = (result.blocking != 0).any(-1)
        is_final = result.done & (is_blocked | (part == 1.0))
        # after a success more of the motion is considered, after a failure the part near the scale that was found
        growth = jnp.where(result.done, ATTEMPT_GROWTH, 2.0 * jnp.clip(jnp.nan_to_num(result.scale), *ATTEMPT_SCALE))
        iterations = before.iterations + result.iterations
        result = result._replace(scale=part * result.scale, iterations=iterations, done=is_final)
        return number + 1, jnp.minimum(part * growth, 1.0), choose(before.done, before, result)

    def is_running(carry: tuple[Array, Array, SaturationResult]) -> Array:
        number, _, result = carry
        return (number < SATURATION_ATTEMPTS) & ~jnp.all(result.done) & jnp.any(result.iterations < max_iterations)

    return jax.lax.while_loop(is_running, attempt, (zeros[0], ones, start))[2]


def _attempt(
    problem: ScaledMotion, compliance: Float[Array, ""], searching: Bool[Array, " B"], max_iterations: int
) -> SaturationResult:
    constraints, root, start = jax.vmap(_tableau, (0, None))(problem, compliance)
    zeros = jnp.zeros(root.shape[0], jnp.int32)
    end = dual_active_set(constraints, start, searching=searching, iterations=zeros, max_iterations=max_iterations)
    active_set = jax.vmap(_active_set)(problem, root, end)
    result = jax.vmap(_result)(problem, active_set, _refined(problem, active_set), end.iterations)
    return result._replace(done=result.done & (end.iterations < max_iterations))


def _tableau(problem: ScaledMotion, compliance: Float[Array, ""]) -> tuple[Constraints, Float[Array, " n"], DualState]:
    """Return bounds and start of the dual method without active joints, and the scale of each joint."""
    # T = P + compliance m m', in units in which its diagonal is 1
    unit = _motion_direction(problem)
    tableau = problem.projector + compliance * unit[:, None] * unit[None, :]
    diagonal = jnp.diagonal(tableau)
    root = 1.0 / jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0))
    value = problem.unbounded(jnp.ones((), unit.dtype))
    roundoff = root * SATURATION_ROUNDOFF * problem.size(jnp.ones((), unit.dtype))
    constraints = Constraints(
        lower=problem.lower * root,
        upper=problem.upper * root,
        equality=jnp.zeros(len(value), bool),
        roundoff=Roundoff(roundoff, roundoff),
        # of a joint that hardly moves, the projector's roundoff is no way to move it
        scale=jnp.where(diagonal > 0.0, jnp.maximum(1.0, PROJECTOR_ROUNDOFF * root**2), 0.0).astype(value.dtype),
    )
    inactive = jnp.full(len(value), INACTIVE, jnp.int32)
    scaled = tableau * root[:, None] * root[None, :]
    start = initial_state(scaled, value * root, jnp.zeros_like(value), inactive)
    return constraints, root, start


def _motion_direction(problem: ScaledMotion) -> Float[Array, " n"]:
    """Return the motion scaled to unit length."""
    length = jnp.sqrt(jnp.sum(problem.motion**2))
    return problem.motion / jnp.where(length > 0.0, length, 1.0)


class _ActiveSet(NamedTuple):
    """Active set, with the quantities for solving it without the penalty."""

    active: Int[Array, " n"]
    y: Float[Array, " n"]  # multipliers
    inverse: Float[Array, "n n"]  # nearly that of the projector's block of the saturated joints; 0 outside of it
    normal: Float[Array, " n"]  # 0 where nothing blocks the motion
    blocking: Int[Array, " n"]
    blocker: Int[Array, ""]


def _active_set(problem: ScaledMotion, root: Float[Array, " n"], end: DualState) -> _ActiveSet:
    """Return the saturated joints, without one joint of a linearly dependent set.

    If the set blocks the motion, that joint is the one which the others determine best. If the whole motion ends on
    its bounds, it is the joint whose removal leaves all multipliers with the right sign.
    """
    # the dual method's answer, back in the units of the joints
    active = jnp.where(end.active == INACTIVE, 0, jnp.where(end.active == AT_UPPER, 1, -1)).astype(jnp.int32)
    is_active = active != 0
    y = jnp.where(is_active, end.multiplier * root, 0.0)
    block = is_active[:, None] & is_active[None, :]
    inverse = jnp.where(block, end.tableau * root[:, None] * root[None, :], 0.0)
    # the block times the motion is the one combination that the null space does not change, if there is any
    normal = -apply(inverse, _motion_direction(problem))
    largest = jnp.max(jnp.abs(normal))
    normal = normal / jnp.where(largest > 0.0, largest, 1.0)
    normal = jnp.where(jnp.abs(normal) > NEGLIGIBLE_ENTRY, normal, 0.0)
    blocks = (largest > 0.0) & (jnp.max(jnp.abs(apply(problem.projector, normal))) <= INDEPENDENCE_TOL)
    # where the whole motion ends, multipliers are not of the penalty's order: the one that reaches 0 first is released
    ratios = jnp.where(normal != 0.0, y / jnp.where(normal != 0.0, normal, 1.0), jnp.inf)
    is_whole = blocked_scale(problem, active, normal) >= 1.0 - SATURATION_ROUNDOFF
    blocker = first_smallest(jnp.where(is_whole, ratios, -jnp.abs(normal)))
    removed = blocks & (jnp.arange(len(normal)) == blocker)
    # the inverse of the block without the blocker, and multipliers without the part of the penalty's order
    column = inverse[blocker]
    pivot = column[blocker]
    reduced = inverse - column[:, None] * column[None, :] / jnp.where(pivot != 0.0, pivot, 1.0)
    at_blocker = normal[blocker]
    remaining = y - y[blocker] * normal / jnp.where(at_blocker != 0.0, at_blocker, 1.0)
    return _ActiveSet(
        active=jnp.where(removed, 0, active),
        y=jnp.where(blocks, jnp.where(removed, 0.0, remaining), y),
        inverse=jnp.where(blocks, jnp.where(removed[:, None] | removed[None, :], 0.0, reduced), inverse),
        normal=jnp.where(blocks, normal, 0.0),
        blocking=jnp.where(blocks & (normal != 0.0), active, 0),
        blocker=blocker,
    )


class _Iterate(NamedTuple):
    """Iterate of the refinement with its residuals."""

    normal: Float[Array, " n"]
    y: Float[Array, " n"]
    scale: Float[Array, ""]
    x: Float[Array, " n"]  # with the rows of all levels where they should be
    bound_residual: Float[Array, ""]  # of the saturated joints, relative to the size
    normal_residual: Float[Array, ""]  # the part of the normal that the null space changes


def _refined(problem: ScaledMotion, active_set: _ActiveSet) -> _Iterate:
    """Refine the answer until the active joints are at their bounds; every array has a leading axis of problems."""

    def body(carry: tuple[Array, _Iterate]) -> tuple[Array, _Iterate]:
        return carry[0] + 1, jax.vmap(_refine)(problem, active_set, carry[1])

    def is_running(carry: tuple[Array, _Iterate]) -> Array:
        residual = jnp.maximum(carry[1].bound_residual, carry[1].normal_residual)
        return (carry[0] < MAX_SATURATION_REFINEMENTS) & jnp.any(residual > SATURATION_ACCURACY)

    first = jax.vmap(_evaluate)(problem, active_set, active_set.normal, active_set.y)
    return jax.lax.while_loop(is_running, body, (jnp.zeros((), jnp.int32), first))[1]


def _refine(problem: ScaledMotion, active_set: _ActiveSet, at: _Iterate) -> _Iterate:
    # one step of iterative refinement each, with the tableau's block as the approximate inverse
    normal = at.normal - apply(active_set.inverse, apply(problem.projector, at.normal))
    gap = jnp.where(active_set.active != 0, problem.bound(active_set.active) - at.x, 0.0)
    return _evaluate(problem, active_set, normal, at.y + apply(active_set.inverse, gap))


def _evaluate(problem: ScaledMotion, active_set: _ActiveSet, normal: Array, y: Array) -> _Iterate:
    # the scale that the blocking joints allow, x on it, and what is left of both conditions
    is_blocked = (active_set.blocking != 0).any()
    active = jnp.where(active_set.active != 0, active_set.active, active_set.blocking)
    scale = jnp.where(is_blocked, blocked_scale(problem, active, normal), 1.0)
    x = problem.unbounded(scale) + apply(problem.projector, y)
    off = jnp.max(jnp.abs(jnp.where(active_set.active != 0, problem.bound(active_set.active) - x, 0.0)))
    changed = jnp.max(jnp.abs(apply(problem.projector, normal)))
    changed = changed / jnp.maximum(jnp.max(jnp.abs(normal)), jnp.finfo(x.dtype).tiny)
    return _Iterate(normal, y, scale, x, off / jnp.maximum(problem.size(scale), jnp.finfo(x.dtype).tiny), changed)


def _result(problem: ScaledMotion, active_set: _ActiveSet, at: _Iterate, iterations: Array) -> SaturationResult:
    # the blocker is at its bound up to roundoff
    active = jnp.where(active_set.active != 0, active_set.active, active_set.blocking)
    x = clip_to_box(jnp.where(active != 0, problem.bound(active), at.x), problem.lower, problem.upper)
    residual = jnp.max(jnp.abs(x - at.x))
    # a motion whose scale is 0 leaves roundoff of its own
    roundoff = jnp.finfo(x.dtype).eps * problem.size(jnp.ones((), x.dtype))
    # joints that are at their bounds where the whole motion ends do not stop it
    is_whole = at.scale >= 1.0 - SATURATION_ROUNDOFF
    return SaturationResult(
        x=x,
        scale=at.scale,
        active=active_set.active,
        blocking=jnp.where(is_whole, 0, active_set.blocking),
        blocker=active_set.blocker,
        iterations=iterations,
        done=(residual <= SATURATION_RESIDUAL * problem.size(at.scale) + roundoff) & jnp.isfinite(at.x).all(),
    )


def blocked_scale(problem: ScaledMotion, active: Int[Array, " n"], normal: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the scale that puts the active joints at their bounds; no null-space motion changes ``normal . x``.

    ``normal . bound = normal . start + scale normal . motion``.
    """
    gap = jnp.sum(normal * jnp.where(active != 0, problem.bound(active) - problem.start, 0.0))
    rate = jnp.sum(normal * problem.motion)
    return jnp.clip(jnp.where(rate != 0.0, quotient(gap, jnp.where(rate != 0.0, rate, 1.0)), 1.0), 0.0, 1.0)
