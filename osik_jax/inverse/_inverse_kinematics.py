"""Inverse kinematics: configurations that bring frames to poses, or meet tasks."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._errors import OsikTypeError, OsikValueError
from ..collision import Scene
from ..collision._robot_shapes import Given
from ..control._checks import check_setting, checked_limits, checked_start
from ..kinematics._pose_forms import PoseLike
from ..limits import ConfigurationLimit, Limit, Limits, keeps_own
from ..numerics._arguments import as_host_numbers, check_count, concrete
from ..numerics._host import is_traced, untraced
from ..numerics._remembered import hold_numbers, remembered
from ..robot import Robot
from ..robot._configuration import check_configuration
from ..robot._ranges import warn_of_far_joints
from ..schemes import Scheme
from ..tasks import Task
from ._advice import advice
from ._branches import Coordinates, all_solutions
from ._chain_problem import ChainRoute, Settings
from ._fixed import Explored, Searches
from ._free import SEEDS as FREE_SEEDS
from ._free import find_free, find_free_by_steps, read_obstacles
from ._host import in_chunks
from ._problem import read_problem
from ._run import explored, explored_by_core, found_at_once, isolated_at_answers, searched, searched_on
from ._seeds import starting_box
from ._solution import InverseKinematicsSolution, with_fields
from ._task_search import entry_limits
from ._whole import whole_is_possible

_STEPS = 40
_RESTARTS = 7
_SEEDS, _MOST_SEEDS = 64, 256
"""Searches for a target; and for all its solutions, which are up to 16 for six joints and of unequal size."""


def inverse_kinematics(
    robot: Robot,
    tasks: Mapping[str, Task | PoseLike],
    *,
    targets: Mapping[str, Any] | None = None,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    q0: Float[Array, " nq"] | None = None,
    seeds: int | None = None,
    key: int | Array = 0,
    position_tolerance: Float[Array, ""] | float = 1e-3,
    orientation_tolerance: Float[Array, ""] | float = 1e-2,
    nearest: bool = False,
    all: bool = False,
    steps: int = _STEPS,
    restarts: int = _RESTARTS,
    closest: bool = True,
    scene: Scene | None = None,
    clearance: Float[Array, ""] | float = 0.0,
    srdf: Given = None,
) -> InverseKinematicsSolution:
    """Return configurations that bring frames to poses, or meet tasks; else the best ones, with the reason.

    Searches start at quasi-random configurations within the limits. Those that make no progress are given up for
    others, and each target is searched for until it is found or has had ``seeds * (1 + restarts)`` of them. Poses of
    frames that hinges and slides carry are searched for by Levenberg-Marquardt steps projected into the joints' limits;
    with tasks, or where a free or ball joint carries a frame, a step is that of the scheme, every error asked to vanish
    at once.

    A target that is not found gets the configuration with the least error: the best of some local optima, each from the
    best of a group of searches. For poses that is the least sum of squared errors, where a radian counts as
    ``position_tolerance / orientation_tolerance`` metres. With tasks it is the local optimum by their weights that the
    best search leads to. While tracing, and with ``nearest`` or ``all``, that holds for goals of one level: all hard,
    or those of a ``WeightedQP`` or of one priority, with no task above. With ball joints, limits other than joint
    ranges, and of goals of several levels, it is where the search ends.

    Called with numbers, it runs as long as it has to. Where one of its arguments is traced, so inside ``jit``, ``vmap``
    or ``grad``, it takes ``seeds`` searches of ``steps`` steps each: a pure function of a limited amount of work. ``q``
    then is differentiable with respect to poses, the robot's numbers and limits, by the implicit function theorem: of
    the motions that keep the frames on their targets the shortest, joints at a limit staying there. Of poses out of
    reach, and of goals of one level, it is the motion of the least error. ``position_error`` and ``orientation_error``
    have derivatives too. Of other goals out of reach, the derivatives are those of the scheme's next step, not of the
    answer; ``converged`` is False there. Other results are constants.

    Args:
        robot: the robot.
        tasks: by the name of a frame, where it should be, in world axes: ``(position (3,), rotation (3, 3))``,
            ``(position, quaternion w x y z (4,))``, a (4, 4) matrix, a ``jaxlie.SE3``, or a position (3,) alone, whose
            orientation is then free [m]. Arrays with one more axis in front are many targets. Or by any name, a task:
            its gain does not matter, nor do target velocities. Tasks on poses (frames, centre of mass, contacts, axes
            and the like), joints of a ``FreezeTask`` and hard tasks have to be met (``Task.is_goal``); others
            (postures) are preferences, which fade out on the way. Tasks on velocities ask for no motion from ``q0``.
        targets: of tasks, by name, what ``replace(target=...)`` takes; with one more axis in front, many targets.
        scheme: for tasks, as in ``solve``.
        limits: beside the robot's joint limits, as in ``solve``; ``osik_jax.no_limits``: none. With a
            ``CollisionAvoidanceLimit`` or ``PositionBarrier``, steps are those of the scheme. Limits on speeds and
            accelerations are passed over.
        q0: a configuration to start from first, such as the last one of a path. Default: none for poses,
            ``robot.q0`` for tasks. Joints that carry none of the frames stay as they are there. (nq,)
        seeds: number of searches for a target, to begin with (static). Default: 64; for ``nearest`` and ``all``, 64 to
            256 by the number of joints, 256 from six on.
        key: integer or key of ``jax.random``: other starts. The same key and arguments give the same answer.
        position_tolerance: largest distance of a frame from its target [m]; of tasks, of the rows in metres.
        orientation_tolerance: largest angle [rad]; of tasks, of the rows in radians.
        nearest: take all ``seeds`` searches, which start around ``q0`` (or ``robot.q0``), and return the solution that
            is nearest to it of those that they find and that of the call without ``nearest``, which then moves towards
            ``q0`` as far as the frames allow. While tracing, that call follows only where they find none.
        all: take all ``seeds`` searches and return all their solutions that differ, too: ``solutions``, ``count`` and
            ``branches``, the number that differ by more than whole turns. Where they find none, the call without
            ``all`` follows.
        steps: that one search may take (static).
        restarts: how often as many searches again are started for targets that are not found.
        closest: whether targets that are not found get the configuration with the least error (static). False is
            quicker where many targets are out of reach and only ``converged`` is wanted.
        scene: obstacles. Only a configuration in which nothing touches is a solution then: no shape of the robot
            comes nearer than ``clearance`` to the scene or to another shape of the robot. A scene with a leading axis
            has one for each target, for poses of frames that hinges and slides carry. With the compiled core;
            ``nearest`` and ``all`` take the CPU, also where there is a GPU, and then not inside ``jit``. Default: none,
            and shapes of the robot may touch.
        clearance: smallest distance of all pairs of shapes [m].
        srdf: pairs that may touch, besides those of neighbouring bodies: path or text of an SRDF; ``True``: the file
            beside the robot's URDF.

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
    check_count("steps", steps)
    check_count("restarts", restarts, least=0)
    for name, flag in (("nearest", nearest), ("all", all)):
        if not isinstance(flag, bool | np.bool_):
            raise OsikTypeError(
                f"{name} is of type {type(flag).__name__}; it is True or False: q0 is what to be near to"
            )
    limits, dtype = checked_limits(robot, limits), robot.q0.dtype
    home = robot.q0 if q0 is None else _start(robot, q0, dtype)
    problem = read_problem(robot, tasks, targets, scheme, limits, home)
    lower, upper = joint_box(robot, limits)
    tolerance = checked_tolerances(position_tolerance, orientation_tolerance, dtype)
    route = problem.route
    if scene is not None and not isinstance(route, ChainRoute):
        more: dict[str, Any] = dict(targets=targets, scheme=scheme, q0=q0, seeds=seeds, key=key, nearest=nearest)
        more |= dict(all=all, steps=steps, restarts=restarts, closest=closest)
        more |= dict(position_tolerance=position_tolerance, orientation_tolerance=orientation_tolerance)
        solve = partial(inverse_kinematics, robot, tasks, **more)
        return find_free_by_steps(robot, solve, limits or (), scene, clearance, srdf, position_tolerance)
    once = (_SEEDS if scene is None else FREE_SEEDS) if seeds is None else seeds
    seeds = default_seeds(len(route.entries(robot)), nearest or all) if seeds is None else seeds
    check_count("seeds", seeds)
    settings = Settings(home, lower, upper, key, tolerance, seeds, problem.parts)
    traced = not hold_numbers(robot) or is_traced((problem.goals, settings))
    if traced and isinstance(route, ChainRoute):
        route = route._replace(by_core=False)
    if all and traced:
        raise OsikTypeError("all=True counts solutions, which are not known while tracing; leave it out inside jit")
    if scene is None and (srdf is not None or not (isinstance(clearance, float | int) and clearance == 0.0)):
        raise OsikValueError("clearance and srdf go with a scene: Scene({}) has the robot's own shapes alone")
    how, given = Searches(seeds, warm=q0 is not None, near=nearest, every=all), (robot, problem.goals, settings)
    if scene is not None and isinstance(route, ChainRoute):
        obstacles = read_obstacles(robot, route, scene, clearance, srdf)
        many = problem.many or obstacles.many
        results = find_free(*given, once * (1 + restarts), steps, how, obstacles, single=not (many or all))
        found = results.found
        if all:
            found = with_fields(found, **_as_arrays(_all_of(*given, results, route)))
        return found if many or not (all or is_traced(found)) else jax.tree.map(lambda a: a[0], found)
    most, by_core = once * (1 + restarts), not traced and whole_is_possible(route, every=nearest or all)
    # inside jit, operations on numbers would be traced too
    with nullcontext() if traced else untraced():
        if by_core and not problem.many:
            at_once = found_at_once(*given, most, steps, how, route=route)
            if at_once is not None and all:
                batched = at_once._replace(found=jax.tree.map(lambda a: np.asarray(a)[None], at_once.found))
                more = {name: a[0] for name, a in _all_of(*given, batched, route).items()}
                return with_fields(at_once.found, **_as_arrays(more))
            if at_once is not None:
                return at_once.found
        if traced or nearest or all:
            options: dict[str, Any] = dict(settings=settings, how=how, steps=steps, route=route, go_on=closest)
            if by_core:
                run = partial(explored_by_core, robot, most=most, **options)
            else:
                run = partial(explored, robot, fall_back=nearest and traced, **options)
            results = run(problem.goals) if traced else in_chunks(lambda goals, _: run(goals), problem.goals)
            found = results.found
            if not traced:
                found = searched_on(*given, found, most, steps, route=route, warm=how.warm, near=nearest)
            if all:
                found = with_fields(found, **_all_of(*given, results._replace(found=found), route))
        else:
            found = searched(*given, most, steps, route=route, warm=how.warm, go_on=closest)
        if not (traced or np.all(found.converged)):
            missed = np.asarray(found.q)[~np.asarray(found.converged)]
            said = advice(robot, route.asked(settings), route.held(settings), missed)
            found = with_fields(found, advice=said)
        return jax.device_put(found if problem.many else jax.tree.map(lambda a: a[0], found))


# a program that returns its arguments makes arrays of them in a sixth of the time that jax.device_put takes
_as_arrays = jax.jit(lambda given: given)


def _all_of(robot: Robot, goals: Any, settings: Settings, results: Explored, route: Any) -> dict[str, np.ndarray]:
    """Return the fields that answers with all solutions have."""
    alone = isolated_at_answers(robot, goals, settings, results, route=route)
    return all_solutions(results, alone, _coordinates(robot, route, settings))


def _start(robot: Robot, q0: Any, dtype: Any) -> Any:
    """Return a checked configuration to start from; by NumPy unless traced."""
    if not isinstance(q0, np.ndarray | jax.Array) or isinstance(q0, Tracer) or q0.dtype.kind not in "fiu":
        return checked_start(robot, q0).astype(dtype)
    seen = np.asarray(q0)
    check_configuration(robot, seen, "q")
    warn_of_far_joints(robot, seen, "q0")
    return seen.astype(dtype)


def default_seeds(coordinates: int, every: bool) -> int:
    """Return the default number of searches for a number of coordinates; larger if all solutions are wanted."""
    return int(np.clip(2 ** min(coordinates + 2, 30), _SEEDS, _MOST_SEEDS)) if every else _SEEDS


def _coordinates(robot: Robot, route: Any, settings: Settings) -> Coordinates:
    """Return the entries of q that a search moves, as numbers."""
    entries, home = route.entries(robot), np.asarray(settings.home)
    lower, upper = _entry_box(robot, settings.lower, settings.upper)
    whole: Any = lower, upper, np.clip(home, lower, upper)
    return Coordinates(entries, route.turning(robot, settings), *(a[entries] for a in whole))


@remembered
def _entry_box(robot: Robot, lower: Array, upper: Array) -> tuple[Any, Any]:
    given: Any = np.asarray(lower), np.asarray(upper)
    return entry_limits(robot, *starting_box(*given))


def joint_box(robot: Robot, limits: tuple[Limit, ...] | None) -> tuple[Array, Array]:
    """Return the lower and upper ends of the joint ranges [rad or m], each (nv,); the same objects each time."""
    parts = robot, *(() if limits is None else limits)
    return (_known_box if hold_numbers(*parts) else _joint_box)(*parts, own=limits is None)


def _joint_box(robot: Robot, *given: Limit, own: bool) -> tuple[Array, Array]:
    limits = None if own else given
    if keeps_own(limits, ConfigurationLimit):
        return _inward(robot.position_lower, 1.0), _inward(robot.position_upper, -1.0)
    free = jnp.full(robot.nv, jnp.inf, robot.q0.dtype)
    lower, upper = -free, free
    for limit in limits or ():
        if isinstance(limit, ConfigurationLimit):
            lower, upper = jnp.maximum(lower, limit.lower), jnp.minimum(upper, limit.upper)
    return _inward(lower, 1.0), _inward(upper, -1.0)


_known_box = remembered(_joint_box)


def _inward(bound: Array, sign: float) -> Array:
    """Return a single-precision bound moved inside by one number, against rounding beyond the wanted one."""
    if bound.dtype != jnp.float32:
        return bound
    if not is_traced(bound):
        seen = np.asarray(bound)
        return np.where(np.isfinite(seen), np.nextafter(seen, np.float32(sign * np.inf)), seen)  # pyright: ignore
    inner = jnp.nextafter(bound, jnp.full_like(bound, sign * jnp.inf))
    return bound + jax.lax.stop_gradient(jnp.where(jnp.isfinite(bound), inner - bound, 0.0))


def checked_tolerances(position: Any, orientation: Any, dtype: Any) -> Any:
    """Return both tolerances (2,), by NumPy unless traced, because JAX's dispatch costs more than a search."""
    both = [_checked_tolerance(value, dtype) for value in (position, orientation)]
    return (jnp if is_traced(both) else np).stack(both)


def _checked_tolerance(value: Any, dtype: Any) -> Any:
    out = as_host_numbers(value, "a tolerance").astype(dtype)
    seen = concrete(out)
    if out.shape != () or (seen is not None and not (np.isfinite(seen) and seen > 0.0)):
        raise OsikValueError(f"a tolerance is {value!r}; it is one positive number, in metres or radians")
    # smaller tolerances are below the rounding of kinematics of a robot of about a metre
    least = 1e-4 if out.dtype == jnp.float32 else 1e-11
    if seen is not None and seen < least:
        raise OsikValueError(f"a tolerance is {value!r}; {out.dtype} can tell errors of {least:g} and more")
    return out
