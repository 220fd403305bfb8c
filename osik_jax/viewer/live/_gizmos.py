"""Draggable handles: one for each task with a target in space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ...robot.loading._mjmodel import quaternion
from ...tasks import ComTask, FrameTask, Task
from ._handles import Handles, Pose

if TYPE_CHECKING:
    from viser import SceneApi

Dragged = Callable[[str, Pose, int, str], None]
"""Arguments of a drag callback: task, pose, visitor, and phase (start, update or end)."""
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def gizmo_pose(task: Task) -> Pose | None:
    """Return the pose of a task's handle; None if the task has no target in space."""
    if isinstance(task, FrameTask) and not task.bounded:
        position, rotation = (np.asarray(part, float) for part in task.target)
        if not turns(task):
            return position, _UPRIGHT
        return position, quaternion(rotation)
    if isinstance(task, ComTask) and task.target is not None and task.axes == "xyz":
        return np.asarray(task.target, float), _UPRIGHT
    return None


def gizmo_target(task: Task, pose: Pose) -> Any:
    """Return the target of a task whose handle is at a pose."""
    if isinstance(task, ComTask):
        return pose[0]
    if isinstance(task, FrameTask) and not turns(task):
        return pose[0], task.target[1]
    return pose[0], pose[1] / np.linalg.norm(pose[1])


class Gizmos(Handles):
    """Handles of a page's tasks."""

    def __init__(self, scene: SceneApi, size: float, dragged: Dragged, *, below: str = "") -> None:
        """Take the size of the robot [m], the drag callback, and the parent node."""
        super().__init__(scene, dragged)
        self._scale, self._below = 0.13 * size, below
        self._turns: dict[str, bool] = {}

    def show(self, tasks: Mapping[str, Task]) -> None:
        """Show a handle at the target of each given task that has one in space; remove other handles."""
        poses = {name: pose for name, task in tasks.items() if (pose := gizmo_pose(task)) is not None}
        # a task that begins or ceases to turn its frame gets another handle
        self.keep([name for name in poses if self._turns.get(name) == turns(tasks[name])])
        self._turns = {name: turns(tasks[name]) for name in poses}
        for name, pose in poses.items():
            look = dict(scale=self._scale, disable_rotations=not self._turns[name], opacity=0.85)
            self.put(name, f"{self._below}/targets/{name}", pose, **look)


def turns(task: Task) -> bool:
    """Return whether a task tracks an orientation."""
    return isinstance(task, FrameTask) and any(task.kept[3:])
