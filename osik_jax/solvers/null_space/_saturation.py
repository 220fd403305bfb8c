"""Saturation in the null space: projection with hard bounds.

F. Flacco, A. De Luca, O. Khatib, "Motion control of redundant robots under joint constraints: saturation in the null
space", ICRA 2012, and "Control of redundant robots under hard joint constraints: saturation in the null space", IEEE
Transactions on Robotics 31(3), 2015. Level k asks for the motion of eq. 7,

    d = (J_k P_{k-1})^+ (b_k - J_k x_{k-1})

and gets s d: s is the largest scale in [0, 1] for which some x in the box leaves the rows of the levels above unchanged
and has its own at J_k (x_{k-1} + s d); x_k is the smallest such x. So a level is met exactly if the box and the levels
above allow, and otherwise the direction of its task error is kept. For the first level and a box around 0 that is the
direction of the task. Two things differ from the papers. They scale b_k itself, also at the lower levels; that may have
no admissible scale, and then drops the whole task. The motion d always has one. And where a level is scaled down, the
joints that block it can move no more whatever comes after: they are removed from the null space of the levels below,
whose scale would otherwise be 0.

The core takes a problem through all levels (``core/saturation.hpp``), on CUDA devices with a warp of threads for each
problem. Problems that it does not solve are searched here, which is the definition, what runs elsewhere, and the
derivative.

When not to use it: where a large motion along a wrong direction is better than a small one along the right, and where
rows are inequalities. One unreachable row scales its whole level down; ``solve_hqp`` fits it by least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...core import _library
from ...execution._backends import Backend, takes
from ...execution._blocks import BLOCK
from ...execution._candidates import Candidates, certified_or_searched
from ...execution._double import in_double
from ...execution._lanes import in_lanes, with_a_few
from ...execution._rules import found as kept
from ...numerics._constants import BLOCKING_RANK, BOUND_DISTANCE
from .._damping import Damping, narrow_box
from .._inverses import row_space_and_motion
from .._level import Level, PaddedLevel
from . import _cuda
from ._implicit_diff import ActiveJoints, SaturatedResult, with_derivative
from ._padding import Problem, initial_point, pad_levels, without_roundoff
from ._projection import level_motion
from ._scale_path import least_cost
from ._scaled_motion import SaturationResult, ScaledMotion, solve_scaled_motion


class BoundedAnswer(NamedTuple):
    """Answer of all levels inside the box."""

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
    damping: Damping,
    rank_tol: Array | float,
    max_iterations: int,
    backend: Backend = "jax",
) -> BoundedAnswer:
    """Solve level after level, then approach the secondary motion within the remaining freedom.

    The levels are solved in double precision whatever the data are, because roundoff would decide which joints are at
    their bounds. The derivative, at the active sets that were found, is in the precision of the data. The arguments are
    those of ``pad_levels``; ``max_iterations`` limits the changes of the active set in each level.
    """
    problem = pad_levels(levels, lower, upper, secondary, damping, rank_tol)
    solve = in_lanes(in_double(partial(_solve_on_platform, max_iterations, backend)))
    end = kept(solve(jax.lax.stop_gradient(without_roundoff(problem))))
    x, projector, scales = with_derivative((end.x, end.projector, end.scales), end.active_joints, problem, backend)
    return BoundedAnswer(x, projector, scales[: len(levels)], end.active, end.iterations, end.done)


class _State(NamedTuple):
    """State between levels: x, its bounds, and the projector onto the remaining freedom."""

    x: Float[Array, " n"]
    lower: Float[Array, " n"]  # of the levels to come
    upper: Float[Array, " n"]
    curvature: Float[Array, " n"]  # bound on the curvature of the rows so far along each variable
    projector: Float[Array, "n n"]  # without the joints that can move no more
    fixed: Int[Array, " n"]  # those, -1 at the lower bound, 1 at the upper; 2 for pinned ones
    active: Int[Array, " n"]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


def _solve_on_platform(max_iterations: int, backend: Backend, problem: Problem) -> SaturatedResult:
    search = partial(_solve_levels, max_iterations, backend)
    kernels = {}
    _, _, m, n = problem.levels.matrix.shape
    if takes(backend, "core-cuda", fits=_cuda.fits(n, (m,), "saturation")):
        kernels["core-cuda"] = _kernel_candidates(max_iterations, search, partial(by_core, _cuda.saturate), None)
    if takes(backend, "core", fits=True):
        kernels["core"] = _kernel_candidates(max_iterations, search, partial(by_core, _library.call), BLOCK)
    return certified_or_searched(kernels, search, problem)


def _kernel_candidates(
    max_iterations: int,
    search: Callable[[Problem], SaturatedResult],
    solve: Callable[[Problem, int], SaturatedResult],
    block: int | None,
) -> Candidates:
    """Return the function that uses a kernel, which checks its own answers, and the search in blocks for the rest."""

    def search_rest(result: SaturatedResult, problem: Problem) -> SaturatedResult:
        is_final = result.done | (result.iterations >= max_iterations)
        return with_a_few(problem, result, is_final, lambda problem, _: search(problem), block)

    return Candidates(lambda problem: solve(problem, max_iterations), search_rest)


def _solve_levels(max_iterations: int, backend: Backend, problem: Problem) -> SaturatedResult:
    """Solve all levels of a batch in plain JAX; arrays have a leading axis of problems, then of levels if any."""
    x, projector = jax.vmap(initial_point)(problem)
    fixed = jnp.where(problem.lower == problem.upper, 2, 0).astype(jnp.int32)
    zeros = jnp.zeros(x.shape[0], jnp.int32)

    def solve_level(
        state: _State, each: tuple[PaddedLevel, Damping, Array]
    ) -> tuple[_State, tuple[Array, ActiveJoints]]:
        # eq. 7 without bounds, then the largest scale of that motion in the box
        motion, damping = jax.vmap(partial(_level_problem, backend))(problem, state, *each)
        result = solve_scaled_motion(motion, max_iterations)
        # bounds may make the damped motion too dear: a part of it is then the optimum
        result, ending, length = least_cost(motion, result, each[0], damping, problem.rank_tol, max_iterations)
        after, joints = jax.vmap(partial(_after_level, backend))(state, motion, result, ending, length, *each[:2])
        return after, (jnp.where(result.done, length * result.scale, 0.0), joints)

    start = _State(x, problem.lower, problem.upper, jnp.zeros_like(x), projector, fixed, fixed, zeros, zeros == 0)
    across = jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), (problem.levels, problem.damping, problem.targets))
    end, (scales, joints) = jax.lax.scan(solve_level, start, across)
    scales, joints = jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), (scales, joints))
    # a joint may have stopped at the trust region of its level, or damped on its way to the bound
    bound = jnp.where(end.active < 0, problem.lower, problem.upper)
    away = (jnp.abs(end.active) == 1) & (jnp.abs(end.x - bound) > BOUND_DISTANCE * (1.0 + jnp.abs(bound)))
    active = jnp.where(away, 0, end.active)
    return SaturatedResult(end.x, end.projector, scales, joints, active, end.iterations, end.done)


def by_core(call: Callable[..., list[Array]], problem: Problem, max_iterations: int) -> SaturatedResult:
    """Return the core's answers for a batch, and in ``done`` whether each problem has one."""
    batch, count, _, n = problem.levels.matrix.shape
    joints = (count,), (count, n), (count, n), (count,), (n,), (2,)
    x, projector, scales, ended, at_bound, blocking, blocker, active, report = call(
        "saturation",
        _library.shapes_of(batch, ((n,), (n, n), (count,)), joints),  # as in ``SaturationAnswer``
        *(*problem.levels, *problem.damping, problem.targets, problem.lower, problem.upper, problem.rank_tol),
        np.array([max_iterations], np.int32),
    )
    found = ActiveJoints(ended != 0, at_bound, blocking, blocker, ended)
    return SaturatedResult(x, projector, scales, found, active, report[:, 1], report[:, 0] != 0)


def _level_problem(
    backend: Backend, problem: Problem, state: _State, level: PaddedLevel, damping: Damping, target: Array
) -> tuple[ScaledMotion, Array]:
    """Return the motion that a level demands, the box of x, and the damping of the level."""
    motion, projector, total = level_motion(level, state.x, state.projector, damping, problem.rank_tol, backend)
    # the trace is the number of directions that are left; where none is, the numbers are roundoff
    space = jnp.where(jnp.trace(projector) < 0.5, 0.0, projector)
    return ScaledMotion(state.x, motion, target, space, state.lower, state.upper), total


def _after_level(
    backend: Backend,
    state: _State,
    motion: ScaledMotion,
    result: SaturationResult,
    ending: Array,
    length: Array,
    level: PaddedLevel,
    damping: Damping,
) -> tuple[_State, ActiveJoints]:
    """Return the state for the next level; x stays if the search failed."""
    active, blocking = (jnp.where(result.done, joints, 0) for joints in (result.active, result.blocking))
    # the blocking joints can move no more: their columns are removed from the projector
    columns = jnp.where((blocking != 0)[:, None], motion.projector, 0.0)
    zero = jnp.zeros((), columns.dtype)
    space, _ = row_space_and_motion(columns, columns[:, 0], zero + BLOCKING_RANK, zero, None, backend=backend)
    keep = (blocking == 0)[:, None] & (blocking == 0)[None, :]
    fixed = jnp.where(state.fixed == 0, blocking, state.fixed)
    x = jnp.where(
        result.done & (length < 1.0),
        state.x + length * (result.x - state.x),
        jnp.where(result.done, result.x, state.x),
    )
    # what the levels below may spend of the level's progress
    lower, upper, curvature = narrow_box(damping, level, state.curvature, x, state.lower, state.upper)
    after = _State(
        x=x,
        lower=lower,
        upper=upper,
        curvature=curvature,
        projector=jnp.where(keep, motion.projector - space, 0.0),
        fixed=fixed,
        active=jnp.where(fixed != 0, fixed, active),
        iterations=state.iterations + result.iterations,
        done=state.done & result.done,
    )
    return after, ActiveJoints(result.done, active, blocking, result.blocker, ending)
