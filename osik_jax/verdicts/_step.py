"""Verdict on a control step: the joints, shapes and tasks that stop it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikValueError
from ..control._checks import check_setting, check_target_names, check_tasks, checked_configuration, checked_limits
from ..control._step import Targets, Tasks, aim, in_type_of, step, velocity_problem
from ..inverse._task_search import is_goal, sizes_of
from ..kinematics import forward_kinematics
from ..limits import CollisionAvoidanceLimit, Limit, Limits, with_own_limits
from ..robot import Robot
from ..robot._joint_selection import dof_names
from ..schemes import Scheme, VelocityProblem, WeightedQP
from ..schemes._default import scheme_for
from ..solvers import Status
from ..tasks import Task
from ..tasks._rows import rows_of

_PUSHED = 1e-3
"""A bound or a task stops a goal if the goal's force on it is at least this, relative to the largest possible one."""
_AT_BOUND = 1e-6
"""Distance to a bound on a velocity, relative to the bound or 1, up to which the velocity is at the bound."""
_AT_REST = 1e-3
"""Speed of the fastest joint [rad/s or m/s] up to which a robot counts as at rest."""
_NEAR = 5e-3
"""Pairs of shapes are named if they are nearer than this to their least distance [m]."""


class StepVerdict(NamedTuple):
    """Verdict on a control step; ``print`` shows it in words.

    Attributes:
        status: of the step.
        missed: the goals that are beyond their tolerance: error [m] and [rad], by task name. {name: (2,)}
        joints: names of the joints whose bounds stop a missed goal.
        pairs: names of the shapes that may come no nearer and stop a missed goal.
        tasks: names of the tasks that stop a missed goal: of a higher priority, or pulling the other way.
        text: the verdict in words.
    """

    status: Status
    missed: dict[str, Float[np.ndarray, "2"]]
    joints: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    tasks: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        return self.text


class _Stops(NamedTuple):
    """Joints, limits and tasks that stop one goal."""

    joints: Array  # -1 or 1 where a dof's lower or upper bound does, else 0. (nv,)
    limits: list[Array]  # whether the rows of each limit do
    tasks: dict[str, Array]  # whether each other task does, by name
    stretched: Array  # whether the goal has no force on the dofs that are not at a bound


class _Measured(NamedTuple):
    """Numbers of a step from which its verdict is made."""

    speed: Any  # of the fastest joint [rad/s or m/s]
    errors: dict[str, Any]  # of each goal: [m] and [rad]. {name: (2,)}
    stops: dict[str, _Stops]  # by goal
    tightest: Any  # the place of the limit that gives each dof's lower and upper bound. (2, nv)
    gaps: list[Any]  # of each collision limit, the distances of its pairs less the least ones [m]


class _Reasons(NamedTuple):
    lines: list[str]
    joints: list[str]
    pairs: list[tuple[str, str]]
    tasks: list[str]


def explain_step(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks,
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float = 0.005,
    targets: Targets | None = None,
    position_tolerance: float = 1e-3,
    orientation_tolerance: float = 1e-2,
) -> StepVerdict:
    """Return what stops the tasks at configuration q: joints at their bounds, near shapes, other tasks.

    It takes the arguments of ``solve`` and solves the step again, outside of ``jit``. A goal is a task on where
    something is (``FrameTask``, ``ComTask`` and so on), or a hard task with an error; postures and dampings are none.

    Args:
        robot: the robot.
        q: configuration, such as the last one of a rollout. (nq,)
        tasks: as in ``solve``.
        scheme: as in ``solve``.
        limits: as in ``solve``.
        dt: as in ``solve``.
        targets: as in ``solve``.
        position_tolerance: error up to which a goal is met [m]; errors in other units count as metres.
        orientation_tolerance: the same for angles [rad].

    Raises:
        KeyError, TypeError, ValueError: as in ``solve``; something is traced, or a tolerance is not positive.
    """
    check_concrete("explain_step", robot, q, tasks, targets)
    check_setting("explain_step(robot, q, tasks)", robot, scheme, dt)
    limits = checked_limits(robot, limits)
    check_tasks(tasks, robot)
    check_target_names(tasks, targets)
    q = checked_configuration(robot, q)
    aimed, allowed = aim(dict(tasks), targets), as_tolerances(position_tolerance, orientation_tolerance)
    bounds = with_own_limits(robot, limits)
    chosen = scheme_for(aimed, q.dtype) if scheme is None else scheme
    dt = in_type_of(dt, q)
    answer = step(robot, q, aimed, scheme, limits, dt)  # the program of ``solve``
    measured = jax.device_get(_measured(robot, q, aimed, chosen, bounds, dt, answer.velocity))
    missed = {name: error for name, error in measured.errors.items() if (error > allowed).any()}
    reasons = {name: _reasons(robot, measured, bounds, name) for name in missed}
    return _verdict(Status(int(answer.status)), measured, missed, reasons)


def _verdict(
    status: Status, measured: _Measured, missed: dict[str, Any], reasons: Mapping[str, _Reasons]
) -> StepVerdict:
    speed = float(measured.speed)
    moving = "at rest" if speed <= _AT_REST else f"moving, the fastest joint at {speed:.3g} rad/s or m/s"
    lines = [f"{status.name}, {moving}"]
    for name, error in measured.errors.items():
        lines.append(f"{name}: {'' if name in missed else 'met, '}{in_words(error)} off")
        lines += [f"  {line}" for line in reasons[name].lines] if name in missed else []
    joints, pairs, tasks = (
        tuple(dict.fromkeys(name for own in reasons.values() for name in getattr(own, kind)))
        for kind in ("joints", "pairs", "tasks")
    )
    return StepVerdict(status, missed, joints, pairs, tasks, "\n".join(lines))


@jax.jit
def _measured(
    robot: Robot, q: Array, tasks: dict[str, Task], scheme: Scheme, limits: tuple[Limit, ...], dt: Array, v: Array
) -> _Measured:
    """Return the errors at q and what stops each goal, from the step's velocity v."""
    kinematics = forward_kinematics(robot, q)
    problem = velocity_problem(robot, kinematics, q, tasks, limits, dt)
    errors, slack = errors_of(robot, q, tasks), problem.slack(v)
    boxes = jnp.stack([jnp.stack(limit.box(robot, q, dt)) for limit in limits])
    own = [limit.rows(robot, kinematics, q, dt) for limit in limits]

    def stops(goal: str) -> _Stops:
        rows = problem.rows[goal]
        force = rows.jacobian.T @ (rows.weight * slack[goal])
        most = jnp.sqrt(rows.weight @ slack[goal] ** 2) * jnp.sqrt(rows.weight @ rows.jacobian**2)
        pushed = jnp.abs(force) > _PUSHED * most
        low, high = _at(v, problem.lower, problem.upper)
        joints = jnp.where(pushed & high & (force < 0.0), 1, jnp.where(pushed & low & (force > 0.0), -1, 0))
        free = jnp.where(joints == 0, force, 0.0)
        by_limits = [
            jnp.zeros((), bool) if of is None else _stopping(of.jacobian, of.lower, of.upper, v, free) for of in own
        ]
        by_tasks = {name: _in_the_way(problem, name, goal, scheme, v, slack, free) for name in tasks if name != goal}
        return _Stops(joints, by_limits, by_tasks, ~(pushed & (joints == 0)).any())

    gaps = [
        limit.distances(robot, kinematics) - limit.minimum_distance
        for limit in limits
        if isinstance(limit, CollisionAvoidanceLimit)
    ]
    tightest = jnp.stack([jnp.argmax(boxes[:, 0], 0), jnp.argmin(boxes[:, 1], 0)])
    speed = jnp.max(jnp.abs(v), initial=0.0)
    return _Measured(speed, errors, {name: stops(name) for name in errors}, tightest, gaps)


def _at(value: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return whether each value is at its lower, and at its upper bound."""
    near = _AT_BOUND * jnp.maximum(1.0, jnp.abs(value))
    return value <= lower + near, value >= upper - near


def _stopping(jacobian: Array, lower: Array, upper: Array, v: Array, force: Array) -> Array:
    """Return whether an active row of these keeps v from going on against a force (the gradient of a goal's cost)."""
    low, high = _at(jacobian @ v, lower, upper)
    along = jacobian @ force
    most = _PUSHED * jnp.linalg.norm(jacobian, axis=1) * jnp.linalg.norm(force)
    return ((low & (along > most)) | (high & (along < -most))).any()


def _in_the_way(
    problem: VelocityProblem, name: str, goal: str, scheme: Scheme, v: Array, slack: dict[str, Array], force: Array
) -> Array:
    """Return whether a task stops a goal: it comes first and its active rows feel the force, or it pulls against it."""
    rows, rank = problem.rows[name], dict(problem.priorities)
    strict, hard = not isinstance(scheme, WeightedQP), goal in problem.hard
    if name in problem.hard or (strict and not hard and rank[name] < rank[goal]):
        return _stopping(jnp.where(rows.weight[:, None] > 0.0, rows.jacobian, 0.0), rows.lower, rows.upper, v, force)
    if hard or (strict and rank[name] > rank[goal]):
        return jnp.zeros((), bool)
    against = (rows.jacobian.T @ (rows.weight * slack[name])) @ force
    return against < -_PUSHED * jnp.sum(force**2)


def _reasons(robot: Robot, measured: _Measured, limits: Sequence[Limit], goal: str) -> _Reasons:
    """Return what stops a goal, one sentence each, with the names of joints, shapes and tasks."""
    stops, names = measured.stops[goal], dof_names(robot)
    dofs, pairs = np.flatnonzero(stops.joints), _near_pairs(measured, limits, stops)
    lines = [
        f"{names[i]} is at its {('lower', 'upper')[upper]} {bound.bound_name or f'bound of a {type(bound).__name__}'}"
        for i, upper in ((i, int(stops.joints[i] > 0)) for i in dofs)
        for bound in (limits[int(measured.tightest[upper, i])],)
    ]
    for (one, other), gap in pairs.items():
        lines.append(f"{one} and {other} are {round(gap, 6) + 0.0:+.3g} m from as near as they may be")
    lines += [
        f"a {type(limit).__name__} stops it"
        for limit, stopping in zip(limits, stops.limits, strict=True)
        if stopping and not isinstance(limit, CollisionAvoidanceLimit)
    ]
    tasks = [name for name, stopping in stops.tasks.items() if stopping]
    if tasks:
        lines.append(f"other tasks come first or pull the other way: {', '.join(tasks)}")
    if not lines:
        links = "the links are stretched, folded or turned as far as they go"
        lines.append(f"no limit and no task stops it: {links if stops.stretched else 'it is on its way'}")
    return _Reasons(lines, [names[i] for i in dofs], list(pairs), tasks)


def _near_pairs(measured: _Measured, limits: Sequence[Limit], stops: _Stops) -> dict[tuple[str, str], float]:
    """Return the pairs of the collision limits that stop a goal: those nearer than ``_NEAR``, else the nearest one."""
    avoiding = [limit for limit in limits if isinstance(limit, CollisionAvoidanceLimit)]
    stopping = [bool(own) for limit, own in zip(limits, stops.limits, strict=True) if limit in avoiding]
    return {
        limit.pairs[at]: float(gaps[at])
        for limit, gaps, stops_it in zip(avoiding, measured.gaps, stopping, strict=True)
        if stops_it
        for at in np.flatnonzero(gaps <= max(_NEAR, gaps.min()))
    }


def errors_of(robot: Robot, q: Float[Array, " nq"], tasks: Mapping[str, Task]) -> dict[str, Float[Array, "2"]]:
    """Return the error of each goal at q: metres (or the task's own unit), and radians; of bounds, the part outside."""
    # of a gain of 1 the pull is the error
    goals = {
        name: task.replace(gain=1.0) for name, task in tasks.items() if is_goal(task) and "gain" in task.replaceable
    }
    rows = rows_of(robot, forward_kinematics(robot, q), q, goals)
    return {name: jnp.stack(sizes_of(goals[name], own)) for name, own in rows.items()}


def as_tolerances(position: Any, orientation: Any) -> Float[np.ndarray, "2"]:
    """Return both tolerances; raise ValueError unless they are positive numbers."""
    found = np.array([position, orientation], float)
    if not (np.isfinite(found) & (found > 0.0)).all():
        raise OsikValueError(f"the tolerances are {position!r} m and {orientation!r} rad; both are positive numbers")
    return found


def check_concrete(where: str, *given: Any) -> None:
    """Raise ValueError for numbers that are traced: a verdict is text, made outside of jit."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given)):
        raise OsikValueError(f"{where} has traced arguments; a verdict is text: call it outside of jit, vmap and grad")


def in_words(error: Float[np.ndarray, "2"]) -> str:
    """Return an error in metres and radians as text."""
    return f"{error[0]:.3g} m and {error[1]:.3g} rad"
