"""Searches for tasks: set-up from tasks, limits and tolerances, and evaluation of the answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._errors import OsikValueError
from ..control._checks import check_tasks
from ..kinematics import difference, forward_kinematics
from ..limits import CollisionAvoidanceLimit, ConfigurationLimit, Limit, limit_box, with_own_limits
from ..numerics._host import is_traced, on_host
from ..robot import Robot
from ..robot._joint_selection import dof_names, dofs_of
from ..robot._ranges import ball_rotation, independent_balls, with_balls_inside
from ..robot._tree import HINGE, SLIDE
from ..schemes import Scheme
from ..tasks import FrameTask, Task
from ._chain_problem import Settings, allowed
from ._implicit import attached
from ._pool import Errors
from ._seeds import shift_of, starting_box
from ._solution import InverseKinematicsSolution
from ._task_minimum import AT_LIMIT
from ._task_search import Aims, TaskSearch, entry_limits, is_goal
from ._turns import starting_range

_BACKGROUND = 1e-3
"""Largest weight of a preference, relative to the goals': that of a ``PostureTask`` by default."""
# score at which a search ends; the next step would be roundoff
_ENOUGH = 0.01
_RADIUS = 1.0
"""Length by which the rounding of positions is judged [m]."""
# least gradient, relative to its largest value for the error, at which a limit counts as stopping a joint
_STOPPED = 1e-3


class TaskParts(NamedTuple):
    """Tasks, scheme and limits of a ``TaskSearch``."""

    tasks: dict[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]


class _ProjectedRange(ConfigurationLimit):
    """Joint ranges for a search, which projects ball joints into their range after each step."""

    ball_margin: ClassVar[float] = 0.0
    ball_step: ClassVar[float] = float("inf")


class TaskRoute(NamedTuple):
    """Problem of tasks and limits of any kind; hashable."""

    @property
    def starts_anew(self) -> bool:
        """Return False, because each copy of a scheme's step in a program takes long to compile."""
        return False

    def search(self, robot: Robot, settings: Settings, *, warm: bool, near: bool) -> TaskSearch:
        """Return the search for these tasks."""
        parts: TaskParts = settings.parts
        lower, upper = entry_limits(robot, settings.lower, settings.upper)
        turns = turning(robot, parts.tasks)
        first = with_balls_inside(robot.tree, jnp.clip(settings.home, lower, upper), settings.upper)
        low, high = starting_range(*starting_box(lower, upper), first, _widths(robot), turns)
        return TaskSearch(
            robot=robot,
            turns=turns,
            tasks=parts.tasks,
            scheme=parts.scheme,
            limits=parts.limits,
            first=first,
            low=low,
            high=high,
            lower=lower,
            upper=upper,
            angles=settings.upper,
            shift=shift_of(settings.key, robot.nq),
            tolerance=allowed(settings.tolerance, jnp.asarray(_RADIUS, first.dtype)),
            enough=jnp.asarray(_ENOUGH, first.dtype),
            preferred=jnp.ones((), first.dtype),
        )

    def beyond(self, search: TaskSearch, goal: Aims) -> Float[Array, " targets"]:
        """Return 0: no bound is known on what tasks can reach."""
        return jnp.zeros(goal.number.shape, search.first.dtype)

    def entries(self, robot: Robot) -> np.ndarray:
        """Return the entries of q that a search moves."""
        return np.arange(robot.nq)

    def asked(self, settings: Settings) -> dict[str, tuple[bool, ...]]:
        """Return which rows of each frame the tasks use."""
        tasks = settings.parts.tasks.values()
        return {task.frame: task.kept for task in tasks if isinstance(task, FrameTask) and not task.bounded}

    def held(self, settings: Settings) -> dict[str, Task]:
        """Return the goals that tie joints together or hold them: closed loops, coupled and frozen joints."""
        return {name: task for name, task in settings.parts.tasks.items() if task.ties_joints and is_goal(task)}

    def turning(self, robot: Robot, settings: Settings) -> np.ndarray:
        """Return whether a whole turn of each of these entries changes no goal."""
        tasks = settings.parts.tasks
        return np.array(turning(robot, {name: task for name, task in tasks.items() if is_goal(task)}))

    def answer(self, robot: Robot, search: TaskSearch, goal: Any, x: Array, seed: Array, steps: Array) -> Any:
        """Return the answer for many targets: errors computed anew, with the derivative of a solution."""
        q = jax.vmap(attached, in_axes=(0, None, 0))(jax.lax.stop_gradient(search.unwound(x)), search, goal)
        here = jax.lax.stop_gradient(q)
        residual, at_limit, errors = jax.vmap(lambda q, goal: _evaluated(search, q, goal))(q, goal)
        avoiding = (limit for limit in search.limits if isinstance(limit, CollisionAvoidanceLimit))
        limit = next((limit for limit in avoiding if limit.scene is None), None)  # names of a scene are unknown in here
        clearance, pair = (None, None) if limit is None else jax.vmap(lambda q: _clearance(robot, limit, q))(here)
        return InverseKinematicsSolution(
            q=q,
            converged=errors.score <= 1.0,
            position_error=errors.position,
            orientation_error=errors.orientation,
            seed=seed,
            steps=steps,
            residual=jax.lax.stop_gradient(residual),
            at_limit=at_limit,
            beyond_reach=jnp.zeros(len(q), q.dtype),
            base_moved=_base_moved(robot, jax.lax.stop_gradient(search.first), here),
            clearance=clearance,
            nearest_pair=pair,
            joints=tuple(dof_names(robot)),
            pairs=() if limit is None else limit.pairs,
        )


def read_tasks(robot: Robot, given: Mapping[str, Any], home: Array) -> dict[str, Task]:
    """Return the tasks for a search from ``home`` (nq,), without those that say nothing about a configuration.

    Raises:
        TypeError: something that is no task.
        ValueError: a task for another robot, or none that has to be met.
    """
    check_tasks(given, robot)
    sought = {name: task.sought(robot, home) for name, task in given.items()}
    tasks = {name: task for name, task in sought.items() if task is not None}
    if not any(is_goal(task) for task in tasks.values()):
        raise OsikValueError(
            "no task says where anything has to be: give a FrameTask, a ComTask or another task on a pose"
        )
    return _in_background(tasks)


def _in_background(tasks: dict[str, Task]) -> dict[str, Task]:
    """Return the tasks, preferences so light that they do not keep a search away from the goals of their level."""
    goals = [task for task in tasks.values() if is_goal(task)]
    lowest = max(task.priority for task in goals)
    beside = {name: task for name, task in tasks.items() if not is_goal(task) and task.priority <= lowest}
    if not beside:
        return tasks
    # by NumPy unless traced, because JAX's dispatch costs more; inside jit its maximum of an array of JAX is traced
    weights = [[on_host(task.weight) for task in own] for own in (beside.values(), goals)]
    numbers: Any = jnp if is_traced(weights) else np
    heaviest, light = (numbers.max(numbers.stack([numbers.max(weight) for weight in own])) for own in weights)
    share = numbers.minimum(1.0, _BACKGROUND * light / numbers.where(heaviest > 0.0, heaviest, 1.0))
    if numbers is np and share >= 1.0:
        return tasks
    return {**tasks, **{name: task.replace(weight=share * task.weight) for name, task in beside.items()}}


def read_limits(robot: Robot, limits: Sequence[Limit] | None) -> tuple[Limit, ...]:
    """Return the limits on configurations, the robot's own among them; limits on speeds do not bind a search.

    Their rows have gain 1: a step may go as far as their bounds.
    """
    kept = [own for limit in with_own_limits(robot, limits) if (own := limit.sought(robot)) is not None]
    return tuple(_projected(robot, limit) if isinstance(limit, ConfigurationLimit) else limit for limit in kept)


def _projected(robot: Robot, limit: ConfigurationLimit) -> Limit:
    return _ProjectedRange(robot, lower=limit.lower, upper=limit.upper)  # pyright: ignore[reportCallIssue]


def turning(robot: Robot, tasks: Mapping[str, Task]) -> tuple[bool, ...]:
    """Return whether a whole turn of each entry of q moves nothing and changes no task."""
    turns = np.zeros(robot.nq, bool)
    counted = {dof for task in tasks.values() for dof in task.counted_dofs(robot)}
    for joint, at in robot.tree.qpos_address.items():
        turns[at] = robot.tree.joint_types[joint] == HINGE and robot.tree.dof_address[joint] not in counted
    index, factor = robot.tree.qpos_source
    for entry, share in zip(index.tolist(), factor.tolist(), strict=True):
        # a coupled joint with a fractional ratio is elsewhere after a whole turn of its leader
        if share and share % 1.0:
            turns[entry] = False
    return tuple(turns.tolist())


def _widths(robot: Robot) -> Float[np.ndarray, " nq"]:
    """Return half the range of starts of joints without limits; free and ball joints keep their values."""
    width = np.zeros(robot.nq)
    for joint, at in robot.tree.qpos_address.items():
        width[at] = {HINGE: np.pi, SLIDE: 1.0}.get(robot.tree.joint_types[joint], 0.0)
    return width


def _evaluated(
    search: TaskSearch, q: Float[Array, " nq"], goal: Aims
) -> tuple[dict[str, Array], Int[Array, " nv"], Errors]:
    """Return the residual of each goal, which limits stop the robot, and the errors."""
    rows, errors = search.errors(q, goal)
    gradients = [jnp.matmul(own.jacobian.T, own.weight * own.pull, precision="highest") for own in rows.values()]
    sizes = [jnp.sqrt(jnp.sum(own.weight * own.pull**2)) for own in rows.values()]
    levers = [jnp.sqrt(jnp.matmul(own.weight, own.jacobian**2, precision="highest")) for own in rows.values()]
    gradient: Any = sum(gradients)
    most: Any = sum(size * lever for size, lever in zip(sizes, levers, strict=True))
    ranges = [limit for limit in search.limits if isinstance(limit, ConfigurationLimit)]
    lower, upper = limit_box(search.robot, q, ranges, 1.0)
    low, high = lower >= -AT_LIMIT, upper <= AT_LIMIT
    stopped = jnp.abs(gradient) > _STOPPED * most
    at_lower, at_upper = stopped & low & (gradient > 0.0), stopped & high & (gradient < 0.0)
    active = at_upper.astype(jnp.int32) - at_lower.astype(jnp.int32)
    active = _with_balls(search, q, gradient, most, active)
    return {name: jnp.where(own.weight > 0.0, own.pull, 0.0) for name, own in rows.items()}, active, errors


def _with_balls(search: TaskSearch, q: Array, gradient: Array, most: Array, active: Array) -> Array:
    """Mark the first entry of each ball joint that is at the end of its range and is driven further along its axis."""
    for joint in independent_balls(search.robot.tree):
        dofs = np.array(dofs_of(search.robot, [joint]))
        at = search.robot.tree.qpos_address[joint]
        angle, axis = ball_rotation(q[at : at + 4])
        driven = jnp.dot(axis, gradient[dofs]) < -_STOPPED * jnp.max(most[dofs])
        active = active.at[dofs[0]].set((driven & (angle >= search.angles[dofs[0]] - AT_LIMIT)).astype(active.dtype))
    return active


def _base_moved(robot: Robot, first: Float[Array, " nq"], q: Float[Array, "n nq"]) -> Float[Array, "n 2"] | None:
    """Return the largest distance [m] and angle [rad] of a free base from where it is in the first configuration."""
    bases = [robot.tree.dof_address[joint] for joint in robot.tree.free_bases]
    if not bases:
        return None
    away = jax.vmap(lambda q: difference(robot, first, q))(q)
    parts = jnp.stack([away[:, base : base + 6].reshape(-1, 2, 3) for base in bases])
    return jnp.max(jnp.sqrt(jnp.sum(parts**2, -1)), 0)


def _clearance(robot: Robot, limit: CollisionAvoidanceLimit, q: Float[Array, " nq"]) -> tuple[Array, Array]:
    distances = limit.distances(robot, forward_kinematics(robot, q))
    nearest = jnp.argmin(distances)
    return distances[nearest] - limit.minimum_distance, nearest.astype(jnp.int32)
