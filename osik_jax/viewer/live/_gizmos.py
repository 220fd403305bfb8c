"""Draggable handles: one for each task with a target in space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from jaxtyping import Float

from ...tasks import ComTask, FrameTask, Task

if TYPE_CHECKING:
    from viser import SceneApi, TransformControlsEvent, TransformControlsHandle

Pose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]
"""Position [m] and quaternion w x y z."""
Dragged = Callable[[str, Pose, int, str], None]
"""Arguments of a drag callback: task, pose, visitor, and phase (start, update or end)."""
# a smaller change of a handle [m, or of a quaternion] is rounding and is not sent to the page
_MOVED = 1e-9
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def gizmo_pose(task: Task) -> Pose | None:
    """Return the pose of a task's handle; None if the task has no target in space."""
    if isinstance(task, FrameTask) and not task.bounded:
        position, rotation = (np.asarray(part, float) for part in task.target)
        if not turns(task):
            return position, _UPRIGHT
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        return position, quaternion
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


class Gizmos:
    """Handles of a page."""

    def __init__(self, scene: SceneApi, size: float, dragged: Dragged, *, below: str = "") -> None:
        """Take the size of the robot [m], the drag callback, and the parent node."""
        self._scene, self._scale, self._dragged, self._below = scene, 0.13 * size, dragged, below
        self._handles: dict[str, TransformControlsHandle] = {}
        self._held: dict[str, int] = {}
        self._turns: dict[str, bool] = {}

    @property
    def held(self) -> Mapping[str, int]:
        """Return the visitor who drags each task's handle, by task."""
        return dict(self._held)

    def show(self, tasks: Mapping[str, Task]) -> None:
        """Show a handle at the target of each given task that has one in space; remove other handles."""
        wanted = {name: (task, pose) for name, task in tasks.items() if (pose := gizmo_pose(task)) is not None}
        for name in [name for name in self._handles if name not in wanted or self._turns[name] != turns(tasks[name])]:
            self._handles.pop(name).remove()
            self._held.pop(name, None)
        for name, (task, pose) in wanted.items():
            if name not in self._handles:
                self._add(name, task, pose)
            elif name not in self._held:
                self._move(self._handles[name], pose)

    def drop(self, visitor: int) -> None:
        """Release everything that a visitor who left was dragging."""
        for name in [name for name, holder in self._held.items() if holder == visitor]:
            self._held.pop(name, None)

    def _add(self, name: str, task: Task, pose: Pose) -> None:
        handle = self._scene.add_transform_controls(
            f"{self._below}/targets/{name}",
            scale=self._scale,
            disable_rotations=not turns(task),
            depth_test=False,
            opacity=0.85,
            position=pose[0],
            wxyz=pose[1],
        )

        @handle.on_update
        async def _(event: TransformControlsEvent) -> None:
            visitor = event.client_id if event.client_id is not None else -1
            if event.phase == "end":
                self._held.pop(name, None)
            else:
                self._held[name] = visitor
            self._dragged(name, (event.target.position, event.target.wxyz), visitor, event.phase)

        self._handles[name], self._turns[name] = handle, turns(task)

    def _move(self, handle: TransformControlsHandle, pose: Pose) -> None:
        """Move the handle to a pose, if it is not there yet."""
        if np.abs(np.asarray(handle.position) - pose[0]).max() > _MOVED:
            handle.position = pose[0]
        if np.abs(np.asarray(handle.wxyz) - pose[1]).max() > _MOVED:
            handle.wxyz = pose[1]


def turns(task: Task) -> bool:
    """Return whether a task tracks an orientation."""
    return isinstance(task, FrameTask) and any(task.kept[3:])
