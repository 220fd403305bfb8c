"""Implicit differentiation of saturation in the null space, at the fixed active sets of its solution.

Where no joint is about to saturate or to be released, x and the scale solve linear equations: the saturated joints of a
level are at their bounds, and where the level is scaled down, the blocking joints determine by how much. Two
factorisations a level solve them, whose derivatives are known in closed form; the search is not differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._backends import Backend
from ...execution._rules import custom_jvp
from ...numerics._constants import PART, STRAIGHT
from ...numerics._dense import apply, product
from .._damping import narrow_box
from ._padding import Problem, initial_point
from ._projection import damped_step_length, level_motion
from ._scale_path import best_scale, dual_basis, step_to_bounds
from ._scaled_motion import ScaledMotion, blocked_scale


class ActiveJoints(NamedTuple):
    """Active set of one level."""

    done: Bool[Array, ""]
    active: Int[Array, " n"]  # -1 saturated at the lower bound, 1 at the upper, 0 free
    blocking: Int[Array, " n"]  # the joints that limit the level's scale, likewise
    blocker: Int[Array, ""]  # the one of them that the others determine
    ending: Int[Array, ""]  # STRAIGHT, PART or WHOLE


class SaturatedResult(NamedTuple):
    """Answer of all levels, with the active set of each."""

    x: Float[Array, " n"]
    projector: Float[Array, "n n"]
    scales: Float[Array, " L"]
    active_joints: ActiveJoints  # with a leading axis of levels
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


Answer = tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, " L"]]
"""Answer x, projector and scales."""


def with_derivative(answer: Answer, sets: ActiveJoints, problem: Problem, backend: Backend = "jax") -> Answer:
    """Return the answer unchanged, with the derivatives of the linear equations at its active sets."""
    return _attach(jax.lax.stop_gradient(answer), sets, problem, backend=backend)


@custom_jvp
def _attach(answer: Answer, sets: ActiveJoints, problem: Problem, *, backend: Backend) -> Answer:
    return answer


@_attach.defjvp
def _attach_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[Answer, Answer]:
    answer, sets, problem = primals
    _, rates = jax.jvp(lambda p: _solve_at_active_sets(sets, p, backend), (problem,), (tangents[-1],))
    # not the answer alone: the next derivative needs this rule
    return _attach(answer, sets, problem, backend=backend), rates


def _solve_at_active_sets(sets: ActiveJoints, problem: Problem, backend: Backend) -> Answer:
    """Return the answer determined by the active sets of all levels."""

    def solve_level(state: tuple[Array, ...], each: tuple[Any, ...]) -> tuple[tuple[Array, ...], Array]:
        joints, level, damping, target = each
        start, projector, lower, upper, curvature = state
        motion, projector, total = level_motion(level, start, projector, damping, problem.rank_tol, backend)
        way = ScaledMotion(start, motion, target, projector, lower, upper)
        best = partial(best_scale, way, level, total, problem.rank_tol, joints.active)
        step, projector, scale = _level(joints, way, best)
        length = damped_step_length(level, start, step, total, problem.rank_tol)
        length = jnp.where(joints.ending == STRAIGHT, length, 1.0)
        x, scale = start + length * step, length * scale
        return (x, projector, *narrow_box(damping, level, curvature, x, lower, upper)), scale

    across = sets, problem.levels, problem.damping, problem.targets
    start = *initial_point(problem), problem.lower, problem.upper, jnp.zeros_like(problem.lower)
    (x, projector, *_), scales = jax.lax.scan(solve_level, start, across)
    return x, projector, scales


def _level(
    joints: ActiveJoints, problem: ScaledMotion, best: Callable[[Float[Array, "n n"]], Float[Array, ""]]
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """Return step, projector and scale of one level; ``best`` computes the scale of least damped cost."""
    scale, projector = _scale_and_projector(problem, joints)
    # one factorisation after another: see docs/installation.md
    scale, active = jax.lax.optimization_barrier((scale, joints.active))
    dual = dual_basis(problem.projector, active)
    scale = jnp.where(joints.ending == PART, best(dual), scale)
    step = step_to_bounds(problem, scale, active, dual)
    return jnp.where(joints.done, step, 0.0), projector, jnp.where(joints.done, scale, 0.0)


def _scale_and_projector(problem: ScaledMotion, joints: ActiveJoints) -> tuple[Float[Array, ""], Float[Array, "n n"]]:
    """Return the scale, and the projector without the joints that block the motion.

    The blocker's column of the projector is a combination of the others' columns; the same combination of x does not
    depend on what the null space does.
    """
    blocking, blocker = joints.blocking, joints.blocker
    # normal: the combination of the blocking joints that the null space does not change
    others = blocking.at[blocker].set(0)
    dual = dual_basis(problem.projector, others)
    coefficients = apply(dual, problem.projector[:, blocker])
    normal = (-coefficients).at[blocker].set(1.0)
    is_blocked = (blocking != 0).any()
    scale = jnp.where(is_blocked, blocked_scale(problem, blocking, normal), 1.0)
    # the projector without the span of the blocking joints' columns, purified of roundoff
    columns = jnp.where(others != 0, problem.projector, 0.0)
    reduced = problem.projector - product(problem.projector, product(product(columns, dual), problem.projector))
    keep = (blocking == 0)[:, None] & (blocking == 0)[None, :]
    return scale, jnp.where(keep, _purified(reduced), 0.0)


def _purified(projector: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return 3 P^2 - 2 P^3 (McWeeny's purification), which reduces an error e of eigenvalues 0 and 1 to 3 e^2."""
    projector = 0.5 * (projector + projector.T)
    square = product(projector, projector)
    return 3.0 * square - 2.0 * product(square, projector)
