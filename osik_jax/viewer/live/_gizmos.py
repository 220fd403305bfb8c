"""Draggable handles: one for each task with a target in space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ...robot.loading._mjmodel import quaternion
from ...tasks import Task
from ._handles import Handles, Pose

if TYPE_CHECKING:
    from viser import SceneApi

Dragged = Callable[[str, Pose, int, str], None]
"""Arguments of a drag callback: task, pose, visitor, and phase (start, update or end)."""
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def gizmo_target(task: Task, pose: Pose) -> Any:
    """Return the target of a task whose handle is at a pose."""
    return task.gripped(pose[0], pose[1] / np.linalg.norm(pose[1]))


class Gizmos(Handles):
    """Handles of a page's tasks."""

    def __init__(self, scene: SceneApi, size: float, dragged: Dragged, *, below: str = "") -> None:
        """Take the size of the robot [m], the drag callback, and the parent node."""
        super().__init__(scene, dragged)
        self._scale, self._below = 0.13 * size, below
        self._turns: dict[str, bool] = {}

    def show(self, tasks: Mapping[str, Task]) -> None:
        """Show a handle at the target of each given task that has one in space; remove other handles."""
        grips = {name: grip for name, task in tasks.items() if (grip := task.grip()) is not None}
        turns = {name: rotation is not None for name, (_, rotation) in grips.items()}
        # a task that begins or ceases to turn its frame gets another handle
        self.keep([name for name in grips if self._turns.get(name) == turns[name]])
        self._turns = turns
        for name, (position, rotation) in grips.items():
            pose = np.asarray(position, float), _UPRIGHT if rotation is None else quaternion(np.asarray(rotation))
            look = dict(scale=self._scale, disable_rotations=rotation is None, opacity=0.85)
            self.put(name, f"{self._below}/targets/{name}", pose, **look)
