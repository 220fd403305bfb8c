"""Largest scale of a level's motion in the box, and the joints that saturate there.

    min 1/2 |x - target|^2   over   x = start + scale motion + P u,   lower <= x <= upper

for the largest scale <= 1 for which there is such an x. That is a hierarchy of two levels, each solved by the primal
active-set method (``hqp/_primal_active_set.py``). The motion m has no part in the range of P, so the first level is one
row, ``m . x = m . (start + m)``, over the range of P and m. Joints with a multiplier at its optimum block the motion:
their combination ``normal``, the multipliers, is one that the null space does not change,

    normal . x = constant + rate scale,     normal >= 0 at lower bounds, <= 0 at upper ones,

which proves (Farkas), for every x in the box, that the scale is no larger than with these joints at their bounds; one
of them is then where the others put it. The second level is the nearest x to the target, with these joints where they
are.

The basic algorithm of Flacco, De Luca and Khatib saturates joints and never releases one; this is their optimal
variant (T-RO 2015).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._double import first_smallest
from ...execution._lanes import choose
from ...numerics._constants import NEGLIGIBLE_ENTRY, SATURATION_RESIDUAL, SATURATION_ROUNDOFF
from ...numerics._dense import apply
from ...numerics._guarded import quotient
from .._box import clip_to_box
from .._damping import Damping
from .._level import PaddedLevel
from ..hqp._active_rows import drop_dependent, factor_active_rows
from ..hqp._primal_active_set import PrimalState, primal_active_set
from ..hqp._problem import LevelProblem, Tolerances


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
        """Return the step from the start to that answer."""
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
    """Return saturated joints, scale and answer of a batch; not ``done`` at the iteration limit."""
    unbounded = jax.vmap(_unbounded)(problem)

    def search() -> SaturationResult:
        found = jax.vmap(partial(_saturate, max_iterations=max_iterations))(problem, unbounded.done)
        return choose(unbounded.done, unbounded, found)

    return jax.lax.cond(jnp.all(unbounded.done), lambda: unbounded, search)


def _unbounded(problem: ScaledMotion) -> SaturationResult:
    """Return the answer without bounds, ``done`` where it is in the box."""
    one, zero = jnp.ones((), problem.start.dtype), jnp.zeros((), jnp.int32)
    x = problem.unbounded(one)
    inactive = jnp.zeros(x.shape, jnp.int32)
    roundoff = SATURATION_ROUNDOFF * problem.size(one)
    inside = jnp.all((problem.lower - roundoff <= x) & (x <= problem.upper + roundoff))
    return SaturationResult(clip_to_box(x, problem.lower, problem.upper), one, inactive, inactive, zero, zero, inside)


def _saturate(problem: ScaledMotion, skip: Bool[Array, ""], max_iterations: int) -> SaturationResult:
    """Return the answer with bounds; nothing is searched where ``skip``."""
    tolerances, inactive = Tolerances(), jnp.zeros(problem.start.shape, jnp.int32)
    # the first level: as far as the motion goes
    length = jnp.sqrt(jnp.sum(problem.motion**2))
    unit = problem.motion / jnp.where(length > 0.0, length, 1.0)
    rows, goal = unit[None], jnp.sum(unit * problem.start)[None] + length
    space = problem.projector + unit[:, None] * unit[None, :]
    first = _level(problem, rows, goal, problem.start, space)
    far = primal_active_set(first, _primal_state(first, inactive, skip), tolerances, max_iterations)
    is_whole = jnp.sum(unit * (far.x - problem.start)) >= (1.0 - SATURATION_ROUNDOFF) * length
    largest = jnp.max(jnp.abs(far.multiplier))
    normal = far.multiplier / jnp.where(largest > 0.0, largest, 1.0)
    blocking = jnp.where(~is_whole & (jnp.abs(normal) > NEGLIGIBLE_ENTRY), far.active, 0)
    normal = jnp.where(blocking != 0, normal, 0.0)
    # of a dependent set the others determine that joint best which has the largest part
    blocker = first_smallest(-jnp.abs(normal))
    others = blocking.at[blocker].set(0)
    scale = jnp.where(is_whole, 1.0, blocked_scale(problem, blocking, normal))
    # the second level: the nearest point to the target, with the blocking joints where they are
    start = _level(problem, jnp.eye(len(unit), dtype=unit.dtype), problem.target, far.x, problem.projector)
    left = factor_active_rows(start, others, tolerances.rank).projector
    second = start._replace(projector=left, may_block=start.may_block & (blocking == 0))
    kept = jnp.where(blocking != 0, 0, far.active)
    kept = drop_dependent(kept, factor_active_rows(second, kept, tolerances.rank))
    end = primal_active_set(second, _primal_state(second, kept, skip), tolerances, max_iterations)
    active = jnp.where(others != 0, others, end.active)
    # what roundoff has added outside of the motion and the null space is taken away
    at = problem.start + scale * problem.motion + apply(problem.projector, end.x - problem.start)
    saturated = jnp.where(blocking != 0, blocking, active)
    x = clip_to_box(jnp.where(saturated != 0, problem.bound(saturated), at), problem.lower, problem.upper)
    # a motion whose scale is 0 leaves roundoff of its own
    roundoff = jnp.finfo(x.dtype).eps * problem.size(jnp.ones((), x.dtype))
    is_exact = jnp.max(jnp.abs(x - at)) <= SATURATION_RESIDUAL * problem.size(scale) + roundoff
    iterations = far.iterations + end.iterations
    return SaturationResult(x, scale, active, blocking, blocker, iterations, far.done & end.done & is_exact)


def _level(
    problem: ScaledMotion,
    matrix: Float[Array, "m n"],
    goal: Float[Array, " m"],
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
) -> LevelProblem:
    """Return the level matrix x = goal over x + the range of the projector, in the box."""
    n, no = len(x), jnp.zeros(len(x), bool)
    return LevelProblem(
        level=PaddedLevel(matrix, goal, goal, jnp.ones(goal.shape, bool)),
        damping=jnp.zeros((), x.dtype),
        damping_terms=Damping(),
        hard=jnp.eye(n, dtype=x.dtype),
        lower=problem.lower,
        upper=problem.upper,
        may_block=problem.lower < problem.upper,
        is_own=no,
        hard_of_row=jnp.full(goal.shape, n, jnp.int32),
        projector=projector,
        x=x,
    )


def _primal_state(problem: LevelProblem, active: Int[Array, " n"], done: Bool[Array, ""]) -> PrimalState:
    """Return the start of the primal method at the level's x."""
    zero, zeros = jnp.zeros((), jnp.int32), jnp.zeros_like(problem.x)
    return PrimalState(problem.x, active, zeros, problem.level.equal, zero, zeros[0], zero, zero > 0, zero, done)


def blocked_scale(problem: ScaledMotion, active: Int[Array, " n"], normal: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the scale for active joints at their bounds, if their combination is not changed by the null space.

    ``normal . bound = normal . start + scale normal . motion``.
    """
    gap = jnp.sum(normal * jnp.where(active != 0, problem.bound(active) - problem.start, 0.0))
    rate = jnp.sum(normal * problem.motion)
    return jnp.clip(jnp.where(rate != 0.0, quotient(gap, jnp.where(rate != 0.0, rate, 1.0)), 1.0), 0.0, 1.0)
