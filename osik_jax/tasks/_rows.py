"""The rows of all tasks of a tick."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import Kinematics, frame_jacobians
from ..robot import Robot
from ._frame import FrameTask
from ._task import Task, TaskRows


def rows_of(
    robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], tasks: Mapping[str, Task]
) -> dict[str, TaskRows]:
    """``task.rows`` of each; frames that are asked for in the same way are worked on in one go, which is faster."""
    groups: dict[Hashable, dict[str, FrameTask]] = {}
    for name, task in tasks.items():
        if isinstance(task, FrameTask) and type(task) is FrameTask:  # a subclass may have rows of its own
            groups.setdefault(_manner(task), {})[name] = task
    found: dict[str, TaskRows] = {}
    for alike in groups.values():
        found |= _frame_rows(robot, kinematics, alike)
    return {name: found[name] if name in found else task.rows(robot, kinematics, q) for name, task in tasks.items()}


def _manner(task: FrameTask) -> Hashable:
    """Equal for tasks that differ in their numbers, frame and priority alone."""
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(task))
    options = task.kept, task.axes, task.orientation_jacobian, task.lower is None
    return *options, jax.tree.structure(task.gain), shapes


def _frame_rows(robot: Robot, kinematics: Kinematics, tasks: Mapping[str, FrameTask]) -> dict[str, TaskRows]:
    """Of tasks of one manner."""
    frames = [task.frame for task in tasks.values()]
    first, *_ = tasks.values()
    stacked = [jnp.stack(leaves) for leaves in zip(*map(jax.tree.leaves, tasks.values()), strict=True)]
    together = jax.tree.unflatten(jax.tree.structure(first), stacked)
    poses = kinematics.frame_poses(robot, frames)
    rows = jax.vmap(FrameTask.rows_at)(together, *poses, frame_jacobians(robot, kinematics, frames))
    apart = [jax.tree.map(lambda a, i=i: a[i], rows) for i in np.arange(len(frames))]
    if first.lower is None:  # what makes an equality: one array for both bounds
        apart = [TaskRows(one.error, one.jacobian, one.lower, one.lower, one.weight) for one in apart]
    return dict(zip(tasks, apart, strict=True))
