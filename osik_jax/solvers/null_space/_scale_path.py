"""Scale of a damped level's motion with the least damped cost, if the full motion within bounds costs more.

Of all x whose rows move by s times the motion of a level, the search finds the smallest, x(s), and the largest s. On
a set of saturated joints x(s) is linear in s. Near the largest scale of a level out of reach, nearly all joints are
saturated, and the direction in which they saturate jumps from step to step. A damped level therefore stops at the scale
at which

    1/2 |s A motion - error|^2 + 1/2 damping |x(s)|^2 - damping s start . motion

is least along the path x(s). It does not take a part of the straight line to the path's end. Without bounds the optimum
is the motion itself, s = 1. The last term is 0 unless levels above have saturated joints. The cost is convex along the
path, and its slope is continuous, because x(s) is the smallest.

On the saturated joints of its optimum, the scale is a quotient of two sums, and so are its derivatives.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...execution._lanes import choose
from ...execution._rules import custom_jvp
from ...numerics._constants import DERIVATIVE_RANK, PART, PATH_END, PATH_SEARCHES, PATH_STEP, STRAIGHT, WHOLE
from ...numerics._dense import apply, product
from ...numerics._guarded import quotient
from .._level import PaddedLevel
from ._padding import ActiveTask
from ._projection import damped_step_length
from ._scaled_motion import SaturationResult, ScaledMotion, solve_scaled_motion


def least_cost(
    problem: ScaledMotion,
    end: SaturationResult,
    level: PaddedLevel,
    damping: Float[Array, " B"],
    rank_tol: Float[Array, " B"],
    max_iterations: int,
) -> tuple[SaturationResult, Int[Array, " B"], Float[Array, " B"]]:
    """Return the answers at the scales of least damped cost, how each was found (a kind), and a fraction.

    ``WHOLE``: that scale is the largest. ``PART``: it is smaller. ``STRAIGHT``: it was not found, and the answer is the
    fraction of the straight line to the largest scale. For other kinds the fraction is 1. ``end`` has the answers at
    the largest scale; every array has a leading axis of problems.
    """
    chord = jax.vmap(damped_step_length)(level, problem.start, end.x - problem.start, damping, rank_tol)
    wanted = end.done & (chord < 1.0) & (chord * end.scale > 0.0)

    def is_running(carry: tuple[Any, ...]) -> Array:
        return (carry[0] < PATH_SEARCHES) & jnp.any(carry[1])

    def search(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        number, running, scale, low, high, before, ending = carry
        result = solve_scaled_motion(problem._replace(motion=scale[:, None] * problem.motion), max_iterations)
        result = result._replace(scale=scale * result.scale, iterations=before.iterations + result.iterations)
        holds = running & result.done & ~(result.blocking != 0).any(-1)
        best = jax.vmap(best_scale)(problem, level, damping, rank_tol, result.active)
        to_end = holds & (best >= end.scale * (1.0 - PATH_STEP)) & (high == end.scale)
        is_whole = to_end & (scale > end.scale * (1.0 - PATH_END))
        # beyond the least cost the path gets dear
        keeps = holds & ((ending == STRAIGHT) | (best >= scale * (1.0 - PATH_STEP)))
        now = choose(is_whole, end, choose(keeps, result, before))._replace(iterations=result.iterations)
        ending = jnp.where(is_whole, WHOLE, jnp.where(keeps, PART, ending))
        running = holds & ~is_whole & (jnp.abs(best - scale) > PATH_STEP * scale)
        low, high = jnp.where(best > scale, scale, low), jnp.where(best > scale, high, scale)
        inside = (best > low) & (best < high)
        middle = jnp.where(to_end, end.scale * (1.0 - 0.5 * PATH_END), 0.5 * (low + high))
        return number + 1, running, jnp.where(inside, best, middle), low, high, now, ending

    first = jnp.where(wanted, end.scale * chord, 0.0)
    unsearched = jnp.where(chord < 1.0, STRAIGHT, WHOLE).astype(jnp.int32)
    nothing = jnp.zeros_like(first)
    start: tuple[Any, ...] = (jnp.zeros((), jnp.int32), wanted, first, nothing, end.scale, end, unsearched)
    *_, result, ending = jax.lax.while_loop(is_running, search, start)
    # joints that stop the whole motion can move no more, as if all of it were done
    result = result._replace(blocking=end.blocking, blocker=end.blocker)
    return result, ending, jnp.where(ending == STRAIGHT, chord, 1.0)


def best_scale(
    problem: ScaledMotion,
    level: PaddedLevel,
    damping: Float[Array, ""],
    rank_tol: Array | float,
    active: Int[Array, " n"],
    dual: Float[Array, "n n"] | None = None,
) -> Float[Array, ""]:
    """Return the scale with the least damped cost for these joints at their bounds; 1 without any motion.

    ``dual`` is the saturated joints' ``dual_basis``, where it is known.
    """
    known = dual_basis(problem.projector, active) if dual is None else dual
    none = jnp.zeros((), problem.start.dtype)
    begin = problem.start + step_to_bounds(problem, none, active, known)
    # x(s) is linear in s: the motion alone, with bounds, target and start at 0; a difference would be roundoff
    zero = jnp.zeros_like(problem.start)
    homogeneous = ScaledMotion(zero, problem.motion, zero, problem.projector, zero, zero)
    along = step_to_bounds(homogeneous, none + 1.0, active, known)
    task = ActiveTask.at(level, problem.start, rank_tol)
    change = apply(task.rows, problem.motion)
    cost = jnp.sum(change**2) + damping * jnp.sum(along**2)
    gain = jnp.sum(change * task.error) - damping * jnp.sum(begin * along - problem.start * problem.motion)
    moves = cost > 0.0
    return jnp.where(moves, quotient(gain, jnp.where(moves, cost, 1.0)), 1.0)


def step_to_bounds(
    problem: ScaledMotion, scale: Array, active: Int[Array, " n"], dual: Float[Array, "n n"]
) -> Float[Array, " n"]:
    """Return the step from start to x(scale) that brings the active joints to their bounds, refined once."""
    goal = problem.bound(active) - problem.start
    step = problem.unbounded_step(scale)
    for _ in range(2):
        gap = jnp.where(active != 0, goal - step, 0.0)
        step = step + apply(problem.projector, apply(dual.T, gap))
    return jnp.where(active != 0, goal, step)


@custom_jvp
def dual_basis(projector: Float[Array, "n n"], active: Int[Array, " n"]) -> Float[Array, "n n"]:
    """Return C, the pseudo-inverse of the projector's columns of the active joints; other rows are 0.

    C' (bound - x) brings the active joints to their bounds, by the smallest step in the projector's range.
    """
    # QR of the columns of the active joints, these first; dependent ones are left out
    order = jnp.argsort(active == 0, stable=True)
    valid = active[order] != 0
    basis, triangle = jnp.linalg.qr(jnp.where(valid, projector[:, order], 0.0))
    eye = jnp.eye(len(active), dtype=projector.dtype)
    valid = valid & (jnp.abs(jnp.diagonal(triangle)) > DERIVATIVE_RANK)
    both = valid[:, None] & valid[None, :]
    inverse = jax.scipy.linalg.solve_triangular(jnp.where(both, triangle, eye), eye)
    # C = R^-1 Q'
    dual = product(jnp.where(both, inverse, 0.0), jnp.where(valid, basis, 0.0).T)
    return jnp.zeros_like(dual).at[order].set(dual)


@dual_basis.defjvp
def _dual_basis_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Any]) -> tuple[Array, Array]:
    """Return ``dual_basis`` and its derivative, by Golub and Pereyra's formula (``solvers/_inverses.py``)."""
    projector, active = primals
    dual = dual_basis(projector, active)
    columns, moved = (jnp.where(active != 0, matrix, 0.0) for matrix in (projector, tangents[0]))
    rest = moved.T - product(product(moved.T, columns), dual)
    return dual, product(dual, product(dual.T, rest)) - product(dual, product(moved, dual))
