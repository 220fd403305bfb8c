"""From where frames should be to a configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..control._checks import check_setting, checked_limits, checked_start
from ..execution._blocks import in_blocks
from ..limits import ConfigurationLimit, Limit, Limits, keeps_own
from ..numerics._arguments import check_count, concrete
from ..robot import Robot
from ..schemes import Scheme
from ..tasks import Task
from ..tasks._targets import PoseLike
from ._chain_problem import Settings
from ._fixed import LAST, Outcomes, choose, search_all
from ._host import in_chunks, lanes_for
from ._pool import run_pool
from ._problem import read_problem
from ._solution import InverseKinematicsSolution

_STEPS = 40
_RESTARTS = 7
_HOPELESS = 16
"""Searches for a target that is known to be out of reach: for the configuration that comes nearest."""
_TOGETHER = 2
"""Targets whose searches a CPU core goes through together, so that they stay in its cache."""
_SEPARATION = 0.1
"""Solutions that differ by less in every joint [rad or m] are one."""


def inverse_kinematics(
    robot: Robot,
    tasks: Mapping[str, Task | PoseLike],
    *,
    targets: Mapping[str, Any] | None = None,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    q0: Float[Array, " nq"] | None = None,
    seeds: int = 64,
    key: int | Array = 0,
    position_tolerance: Float[Array, ""] | float = 1e-3,
    orientation_tolerance: Float[Array, ""] | float = 1e-2,
    nearest: bool = False,
    all: bool = False,
    steps: int = _STEPS,
    restarts: int = _RESTARTS,
) -> InverseKinematicsSolution:
    """Configurations that bring frames to poses, or meet tasks; or the best that was found, and what stops it.

    Searches start at quasi-random configurations within the limits. Those that make no progress are given up for
    others, and each target is searched for until it is found or has had ``seeds * (1 + restarts)`` of them. Poses of
    frames that hinges and slides carry are searched for by Levenberg-Marquardt steps projected into the joints' limits;
    with tasks, or where a free or ball joint carries a frame, a step is that of the scheme, every error asked to vanish
    at once.

    Called with numbers, it runs as long as it has to. Where one of its arguments is traced, so inside ``jit``, ``vmap``
    or ``grad``, it takes ``seeds`` searches of ``steps`` steps each: a pure function of a fixed amount of work. ``q``
    then is differentiable with respect to poses, the robot's numbers and limits, by the implicit function theorem: of
    the motions that keep the frames on their targets the shortest, joints at a limit staying there. Other results are
    constants.

    Args:
        robot: the robot.
        tasks: by the name of a frame, where it should be, in world axes: ``(position (3,), rotation (3, 3))``,
            ``(position, quaternion w x y z (4,))``, a (4, 4) matrix, a ``jaxlie.SE3``, or a position (3,) alone, whose
            orientation is then free [m]. Arrays with one more axis in front are many targets. Or by any name, a task:
            its gain does not matter, nor do target velocities. Tasks on poses (frames, centre of mass, contacts, axes
            and the like) and hard tasks have to be met; others (postures) are preferences, which fade out on the way.
        targets: of tasks, by name, what ``replace(target=...)`` takes with one more axis in front, for many targets.
        scheme: for tasks, as in ``solve``. Default: ``WeightedQP()``.
        limits: beside the robot's joint limits, as in ``solve``; ``osik_jax.no_limits``: none. With a
            ``CollisionAvoidanceLimit`` or ``PositionBarrier``, steps are those of the scheme. Limits on speeds and
            accelerations are passed over.
        q0: a configuration to start from first, such as the last one of a path. Default: none for poses,
            ``robot.q0`` for tasks. Joints that carry none of the frames stay as they are there. (nq,)
        seeds: number of searches for a target, to begin with (static).
        key: integer or key of ``jax.random``: other starts. The same key and arguments give the same answer.
        position_tolerance: largest distance of a frame from its target [m]; of tasks, of the rows in metres.
        orientation_tolerance: largest angle [rad]; of tasks, of the rows in radians.
        nearest: take all ``seeds`` searches, which start around ``q0`` (or ``robot.q0``), and return the solution that
            is nearest to it of those that they find.
        all: take all ``seeds`` searches and return all their solutions that differ, too: ``solutions``, ``count``.
        steps: that one search may take (static).
        restarts: how often as many searches again are started for targets that are not found.

    Returns:
        One answer, or with a leading axis as many as there are targets. ``converged`` is true only where the errors,
        computed anew at ``q``, are within the tolerances by more than rounding; limits of joints hold exactly.
        ``explain()`` says what stops the others.

    Raises:
        TypeError: something that is no robot, pose, task, scheme or limit.
        KeyError: no such frame or task; the message lists those that exist.
        ValueError: numbers that are no pose, batches of different lengths, a tolerance that the precision cannot tell,
            or no task that says where anything has to be; a robot of the wrong precision, as in ``solve``.

    Warns:
        OsikWarning: a joint is far outside its range in ``q0``, as degrees are.
    """
    check_setting("inverse_kinematics(robot, tasks)", robot, scheme, 1.0)
    check_count("seeds", seeds)
    check_count("steps", steps)
    check_count("restarts", restarts, least=0)
    limits, dtype = checked_limits(robot, limits), robot.q0.dtype
    home = robot.q0 if q0 is None else checked_start(robot, q0).astype(dtype)
    problem = read_problem(robot, tasks, targets, scheme, limits)
    lower, upper = joint_box(robot, limits)
    tolerance = _together(
        [checked_tolerance(position_tolerance, dtype), checked_tolerance(orientation_tolerance, dtype)]
    )
    settings = Settings(home, lower, upper, key, tolerance, seeds, problem.parts)
    start: dict[str, Any] = dict(route=problem.route, warm=q0 is not None)
    traced = _is_traced((robot, problem.goals, settings))
    if all and traced:
        raise OsikTypeError("all=True counts solutions, which are not known while tracing; leave it out inside jit")
    if traced or nearest or all:
        run = partial(_explored, robot, settings=settings, seeds=seeds, steps=steps, near=nearest, **start)
        found, outcomes = run(problem.goals) if traced else in_chunks(lambda goals, _: run(goals), problem.goals)
        found = _with_all(found, outcomes, problem.route.entries(robot)) if all else found
    else:
        found = _searched(robot, problem.goals, settings, seeds * (1 + restarts), steps, **start)
    return jax.tree.map(jnp.asarray, found if problem.many else jax.tree.map(lambda a: a[0], found))


def _searched(
    robot: Robot, goals: Any, settings: Settings, seeds: int, steps: int, *, route: Any, warm: bool
) -> InverseKinematicsSolution:
    """By as many searches as each target needs; where there is a configuration to start from, from that alone first."""
    most = np.int32(seeds)
    run = partial(_pooled, route=route, warm=warm, lanes=lanes_for(len(jax.tree.leaves(goals)[0])))

    def chunk(goals: Any, wanted: np.ndarray) -> InverseKinematicsSolution:
        if not warm:
            return run(robot, goals, settings, wanted, most, np.int32(steps))
        found = run(robot, goals, settings, wanted, np.int32(1), np.int32(steps))
        left = wanted & ~np.asarray(found.converged)
        if not left.any():
            return found
        again = run(robot, goals, settings, left, most, np.int32(steps))
        return jax.tree.map(lambda a, b: np.where(left.reshape(-1, *[1] * (a.ndim - 1)), b, a), found, again)

    return in_chunks(chunk, goals)


@partial(jax.jit, static_argnames=("route", "warm", "lanes"))
def _pooled(
    robot: Robot,
    goals: Any,
    settings: Settings,
    wanted: Array,
    seeds: Array,
    longest: Array,
    *,
    route: Any,
    warm: bool,
    lanes: int,
) -> InverseKinematicsSolution:
    search = route.search(robot, settings, warm=warm, near=False)
    most = jnp.where(route.beyond(search, goals) > 0.0, jnp.minimum(seeds, _HOPELESS), seeds)
    found = run_pool(search, goals, wanted, lanes=lanes, seeds=most, longest=longest, enough=search.enough)
    return route.answer(robot, search, goals, found.x, found.seed, found.steps)


@partial(jax.jit, static_argnames=("route", "seeds", "steps", "warm", "near"))
def _explored(
    robot: Robot, goals: Any, *, settings: Settings, route: Any, seeds: int, steps: int, warm: bool, near: bool
) -> tuple[InverseKinematicsSolution, Outcomes]:
    """All searches of each target, to their ends: a pure function of a fixed amount of work."""
    goals, valid = _with_placeholders(goals)
    search = route.search(robot, settings, warm=warm, near=near)
    fixed_search, fixed_goals = jax.lax.stop_gradient((search, goals))
    last = fixed_search.finishing() if near else None

    def some(goals: Any) -> tuple[Outcomes, Array]:
        outcomes = search_all(fixed_search, goals, seeds=seeds, steps=steps, last=last)
        away = jax.vmap(jax.vmap(fixed_search.distance))(outcomes.x) if near else None
        return outcomes, choose(outcomes, away)

    outcomes, best = in_blocks(some, (fixed_goals,), _TOGETHER)
    x = jnp.take_along_axis(outcomes.x, best[:, None, None], 1)[:, 0]
    taken = jnp.full(len(best), seeds * (steps + (LAST if near else 0)), jnp.int32)
    found = route.answer(robot, search, goals, x, best, taken)
    most = jnp.asarray(jnp.finfo(x.dtype).max, x.dtype)
    return (
        dataclasses.replace(
            found,
            converged=found.converged & valid,
            position_error=jnp.where(valid, found.position_error, most),
            orientation_error=jnp.where(valid, found.orientation_error, most),
        ),
        outcomes,
    )


def _with_placeholders(goals: Any) -> tuple[Any, Bool[Array, " targets"]]:
    """The targets with 0 in place of those that are not finite, which traced ones may be; and which are valid."""
    numbers, rest = eqx.partition(goals, eqx.is_inexact_array)
    valid = jnp.ones(len(jax.tree.leaves(goals)[0]), bool)
    for leaf in jax.tree.leaves(numbers):
        valid &= jnp.isfinite(leaf).reshape(len(leaf), -1).all(1)

    def kept(a: Array) -> Array:
        return jnp.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)

    return eqx.combine(jax.tree.map(kept, numbers), rest), valid


def joint_box(robot: Robot, limits: tuple[Limit, ...] | None) -> tuple[Array, Array]:
    """Return the lower and upper ends of the joint ranges [rad or m], each (nv,)."""
    if keeps_own(limits, ConfigurationLimit):
        return _inward(robot.position_lower, 1.0), _inward(robot.position_upper, -1.0)
    free = jnp.full(robot.nv, jnp.inf, robot.q0.dtype)
    lower, upper = -free, free
    for limit in limits or ():
        if isinstance(limit, ConfigurationLimit):
            lower, upper = jnp.maximum(lower, limit.lower), jnp.minimum(upper, limit.upper)
    return _inward(lower, 1.0), _inward(upper, -1.0)


def _inward(bound: Array, sign: float) -> Array:
    """A bound in single precision may be beyond the one that was meant, by its rounding: the next number is not."""
    if bound.dtype != jnp.float32:
        return bound
    if not _is_traced(bound):
        seen = np.asarray(bound)
        return np.where(np.isfinite(seen), np.nextafter(seen, np.float32(sign * np.inf)), seen)  # pyright: ignore
    inner = jnp.nextafter(bound, jnp.full_like(bound, sign * jnp.inf))
    return bound + jax.lax.stop_gradient(jnp.where(jnp.isfinite(bound), inner - bound, 0.0))


def _together(values: Sequence[Any]) -> Any:
    """One array, NumPy's where nothing is traced: operations of JAX's cost more than a search."""
    return (jnp if _is_traced(values) else np).stack(values)


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def checked_tolerance(value: Any, dtype: Any) -> Any:
    out = (jnp if _is_traced(value) else np).asarray(value, dtype)
    seen = concrete(out)
    if out.shape != () or (seen is not None and not (np.isfinite(seen) and seen > 0.0)):
        raise OsikValueError(f"a tolerance is {value!r}; it is one positive number, in metres or radians")
    least = 1e-4 if out.dtype == jnp.float32 else 1e-11
    if seen is not None and seen < least:
        raise OsikValueError(f"a tolerance is {value!r}; {out.dtype} can tell errors of {least:g} and more")
    return out


def _with_all(found: InverseKinematicsSolution, outcomes: Outcomes, entries: np.ndarray) -> InverseKinematicsSolution:
    """With the solutions that differ, the best first; ``entries`` are those of q that a search moves."""
    score, x, q = np.asarray(outcomes.errors.score), np.asarray(outcomes.x), np.asarray(found.q)
    solutions = np.full((*score.shape, q.shape[1]), np.nan, q.dtype)
    counts = np.zeros(len(q), np.int32)
    for target in np.flatnonzero(np.asarray(found.converged)):
        kept = [q[target, entries]]
        for own in x[target][score[target] <= 1.0]:
            if _is_apart(own, kept):
                kept.append(own)
        counts[target] = min(len(kept), score.shape[1])
        solutions[target, : counts[target]] = q[target]
        solutions[target, : counts[target], entries] = np.stack(kept[: counts[target]], 1)
    return dataclasses.replace(found, solutions=jnp.asarray(solutions), count=jnp.asarray(counts))


def _is_apart(x: np.ndarray, others: Sequence[np.ndarray]) -> bool:
    """Whether a configuration differs from each of the others in some joint."""
    return all(np.abs(x - other).max() > _SEPARATION for other in others)
