"""Conversion of a user's poses and tasks to a search problem and its method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..limits import Limit
from ..robot import Robot
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ..tasks import FrameTask, Task
from ._chain import is_plain
from ._chain_problem import ChainRoute
from ._poses import read_poses
from ._task_problem import TaskParts, TaskRoute, read_limits, read_tasks
from ._task_search import CURVATURE, Aims, damped


class Problem(NamedTuple):
    """A search problem."""

    route: ChainRoute | TaskRoute  # the search method
    goals: Any  # pytree with the targets in front
    parts: TaskParts | None  # what else the search is made of; None for a ``ChainRoute``
    many: bool  # whether the user gave a batch


def read_problem(
    robot: Robot, tasks: Any, targets: Any, scheme: Scheme | None, limits: tuple[Limit, ...] | None, home: Array
) -> Problem:
    """Return the search problem for a user's poses, tasks and targets; ``home`` (nq,) is where a search begins.

    Raises:
        TypeError, KeyError, ValueError: as ``inverse_kinematics``.
    """
    if not isinstance(tasks, Mapping):
        raise OsikTypeError(
            f"tasks is a {type(tasks).__name__}; it is a dict from names of frames to poses, or to tasks"
        )
    if not tasks:
        raise OsikValueError("there is nothing to reach: give a frame a pose, or at least one task")
    poses = {name: value for name, value in tasks.items() if not isinstance(value, Task)}
    for name in poses:
        robot.tree.frame(name)
    goal, rows, count = read_poses(robot, poses) if poses else (None, (), None)
    boxed = not any(limit.sees_places for limit in limits or ())
    plain = len(poses) == len(tasks) and is_plain(robot.tree, tuple(poses))
    if goal is not None and plain and boxed and scheme is None:
        if targets is not None:
            raise OsikValueError("targets go with tasks; many poses are arrays with one more axis in front")
        return Problem(ChainRoute(tuple(poses), rows), goal, None, count is not None)
    return _of_tasks(robot, tasks, poses, (goal, rows, count), targets, scheme, limits, home)


def _of_tasks(
    robot: Robot,
    tasks: Mapping[str, Any],
    poses: Mapping[str, Any],
    read: tuple[Any, tuple[tuple[bool, ...], ...], int | None],
    targets: Any,
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    home: Array,
) -> Problem:
    goal, rows, count = read
    framed = {name: FrameTask(robot, name, rows=own) for name, own in zip(poses, rows, strict=True)}
    known = read_tasks(robot, {name: framed.get(name, task) for name, task in tasks.items()}, home)
    aims, number = _aims(targets, known, count)
    many = number is not None
    number = number or 1
    for at, name in enumerate(poses):
        own = goal.position[:, at], goal.rotation[:, at]
        aims[name] = jax.tree.map(lambda a: jnp.broadcast_to(a, (number, *a.shape[1:])), own)
    chosen = scheme_for(known, robot.q0.dtype) if scheme is None else scheme
    goals = Aims(jnp.arange(number, dtype=jnp.int32), aims)
    return Problem(TaskRoute(), goals, TaskParts(known, damped(chosen, CURVATURE), read_limits(robot, limits)), many)


def _aims(targets: Any, tasks: Mapping[str, Task], count: int | None) -> tuple[dict[str, Any], int | None]:
    """Return the targets of tasks as arrays with the targets in front, and how many they are; None: one, no batch."""
    if targets is None:
        return {}, count
    if not isinstance(targets, Mapping):
        raise OsikTypeError(f"targets is a {type(targets).__name__}; it is a dict from names of tasks to many targets")
    aims: dict[str, Any] = {}
    single: dict[str, Any] = {}
    for name, value in targets.items():
        if name not in tasks:
            raise unknown_name("task", name, tuple(tasks))
        aims[name] = jax.tree.map(jnp.asarray, value)
        if not _are_many(tasks[name], aims[name]):
            single[name] = _one_target(name, tasks[name], value)
            continue
        lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(aims[name])}
        if len(lengths) != 1 or lengths == {()} or (count is not None and lengths != {(count,)}):
            expected = "one length" if count is None else f"length {count}, as those of the others"
            raise OsikValueError(
                f"targets[{name!r}] has leading axes {sorted(lengths)}; they are the targets, of {expected}"
            )
        (count,) = lengths.pop()
    shape = (count or 1,)
    single = jax.tree.map(lambda a: jnp.broadcast_to(a, (*shape, *jnp.shape(a))), single)
    return {**aims, **single}, count


def _are_many(task: Task, value: Any) -> bool:
    """Return whether the arrays without their first axis have the shapes of a target of the task.

    Some tasks take a number for an array, so arrays with the shapes of the task's own target are one target.
    """
    leaves, own = jax.tree.leaves(value), getattr(task, "target", None)
    if any(np.ndim(leaf) == 0 for leaf in leaves) or jax.tree.map(jnp.shape, value) == jax.tree.map(jnp.shape, own):
        return False
    first = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), value)
    try:
        jax.eval_shape(lambda target: task.replace(target=target), first)
    except (IndexError, TypeError, ValueError):
        return False
    return True


def _one_target(name: str, task: Task, value: Any) -> Any:
    """Return the one target that the task reads from the value.

    Raises:
        TypeError, ValueError: it is not one target either.
    """
    try:
        return task.replace(target=value).target  # pyright: ignore[reportAttributeAccessIssue]
    except (TypeError, ValueError) as error:
        given = str(error).removesuffix(". Batch with jax.vmap.")
        raise type(error)(f"targets[{name!r}]: {given}; many have one more axis in front") from None
