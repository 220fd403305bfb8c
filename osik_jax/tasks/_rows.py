"""Rows of all tasks of a step."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..execution._platform import cuda_is_default
from ..kinematics import Kinematics
from ..kinematics._forward import moving_frames
from ..robot import Robot
from ._bases import FramedTask, Frames
from ._frame import FrameTask, RelativeFrameTask
from ._plane import ContactTask, WheelTask
from ._pointing import AxisAlignTask, LookAtTask
from ._task import Task, TaskRows

_TOGETHER = (FrameTask, RelativeFrameTask, LookAtTask, AxisAlignTask, ContactTask, WheelTask)
"""Task classes that are evaluated in batches; a subclass may define rows of its own."""
_APART = {"frame", "root", "target_frame", "priority", "hard"}
"""Static fields in which batched tasks may differ, because ``rows_at`` does not use them."""


def rows_of(
    robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], tasks: Mapping[str, Task]
) -> dict[str, TaskRows]:
    """Return ``task.rows`` of each task; frame tasks of the same structure are evaluated in one batch.

    A GPU's kernels keep lanes last in memory, and tasks apart.
    """
    apart = kinematics.backend != "jax" and cuda_is_default()
    groups: dict[Hashable, dict[str, FramedTask]] = {}
    for name, task in tasks.items():
        if isinstance(task, FramedTask) and type(task) in _TOGETHER and not apart:
            groups.setdefault(_manner(task), {})[name] = task
    found: dict[str, TaskRows] = {}
    for alike in groups.values():
        found |= _framed_rows(robot, kinematics, alike)
    return {name: found[name] if name in found else task.rows(robot, kinematics, q) for name, task in tasks.items()}


def _manner(task: FramedTask) -> Hashable:
    """Return a key that is equal for tasks that differ only in numbers, frames and priority."""
    fields = [(f.name, getattr(task, f.name), bool(f.metadata.get("static"))) for f in dataclasses.fields(task)]
    options = tuple(value for name, value, static in fields if static and name not in _APART)
    structure = tuple(jax.tree.structure(value) for _, value, static in fields if not static)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(task))
    return type(task), len(task.frames), options, structure, shapes


def _framed_rows(robot: Robot, kinematics: Kinematics, tasks: Mapping[str, FramedTask]) -> dict[str, TaskRows]:
    """Return the rows of tasks with the same static structure, in one vmapped call."""
    first, *_ = tasks.values()
    frames = [frame for task in tasks.values() for frame in task.frames]
    stacked = [jnp.stack(leaves) for leaves in zip(*map(jax.tree.leaves, tasks.values()), strict=True)]
    together = jax.tree.unflatten(jax.tree.structure(first), stacked)
    found = moving_frames(robot, kinematics, frames)
    by_task = [a.reshape(len(tasks), len(first.frames), *a.shape[1:]) for a in found]

    def rows_at(task: FramedTask, frames: Frames) -> TaskRows:
        return task.rows_at(frames, kinematics.backend)

    rows = jax.vmap(rows_at)(together, Frames(*by_task))
    apart = [jax.tree.map(partial(_of_task, i), rows) for i in np.arange(len(tasks))]
    if not first.bounded:  # one array for both bounds
        apart = [dataclasses.replace(one, upper=one.lower) for one in apart]
    return dict(zip(tasks, apart, strict=True))


def _of_task(i: np.integer, a: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return task i's part of batched arrays, as slices, which XLA joins again without a copy."""
    return a[i] if a.ndim == 1 else a.reshape(-1, *a.shape[2:])[i * a.shape[1] : (i + 1) * a.shape[1]]
