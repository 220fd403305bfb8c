"""Draggable handles in a page: those of tasks with a target in space, and obstacles with theirs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from jaxtyping import Float

from ...robot.loading._poses import quaternion, rotation_matrix
from ...tasks import Task
from .._parts import Part
from ._obstacles import Obstacle
from ._surfaces import part_triangles

if TYPE_CHECKING:
    from viser import SceneApi, TransformControlsEvent, TransformControlsHandle

Pose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]
"""Position [m] and quaternion w x y z."""
Dragged = Callable[[str, Pose, int, str], None]
"""Arguments of a drag callback: task, pose, visitor, and phase (start, update or end)."""
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_MOVED = 1e-9
"""Change of a position [m] or of a quaternion's entries below which it is rounding and is not sent to the page."""
_COLOR = (231, 126, 34)


class Handles:
    """Handles of one kind, by name."""

    def __init__(self, scene: SceneApi, dragged: Dragged) -> None:
        """Take viser's scene and the callback of a drag."""
        self._scene, self._dragged = scene, dragged
        self._handles: dict[str, TransformControlsHandle] = {}
        self._held: dict[str, int] = {}

    @property
    def held(self) -> Mapping[str, int]:
        """Return the visitor who drags each handle, by name."""
        return dict(self._held)

    def drop(self, visitor: int) -> None:
        """Release everything that a visitor who left was dragging."""
        for name in [name for name, holder in self._held.items() if holder == visitor]:
            self._held.pop(name, None)

    def keep(self, names: Collection[str]) -> None:
        """Remove all other handles."""
        for name in [name for name in self._handles if name not in names]:
            self._handles.pop(name).remove()
            self._held.pop(name, None)

    def put(self, name: str, node: str, pose: Pose, **look: Any) -> None:
        """Add a handle as a node of the scene, or move it to the pose unless a visitor holds it."""
        if name not in self._handles:
            self._handles[name] = self._added(name, node, pose, look)
        elif name not in self._held:
            handle, (position, quaternion) = self._handles[name], pose
            if np.abs(np.asarray(handle.position) - position).max() > _MOVED:
                handle.position = position
            if np.abs(np.asarray(handle.wxyz) - quaternion).max() > _MOVED:
                handle.wxyz = quaternion

    def _added(self, name: str, node: str, pose: Pose, look: Mapping[str, Any]) -> TransformControlsHandle:
        handle = self._scene.add_transform_controls(node, position=pose[0], wxyz=pose[1], depth_test=False, **look)

        @handle.on_update
        async def _(event: TransformControlsEvent) -> None:
            visitor = event.client_id if event.client_id is not None else -1
            if event.phase == "end":
                self._held.pop(name, None)
            else:
                self._held[name] = visitor
            at = np.asarray(event.target.position), np.asarray(event.target.wxyz)
            self._dragged(name, at, visitor, event.phase)

        return handle


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


class ObstacleNodes(Handles):
    """Obstacles as nodes of a page's scene, with handles to drag and turn them."""

    def __init__(self, scene: SceneApi, size: float, move: Callable[..., None]) -> None:
        """Take the size of the robot [m] and ``move(obstacle, position, rotation)``, which a drag calls."""

        def dragged(name: str, pose: Pose, *_: object) -> None:
            move(name, pose[0], rotation_matrix(pose[1]))

        super().__init__(scene, dragged)
        self._scale = 0.1 * size
        self._shown: dict[str, Part] = {}
        self._last: Mapping[str, Obstacle] | None = None

    def show(self, obstacles: Mapping[str, Obstacle]) -> None:
        """Show these obstacles and remove others."""
        if obstacles is self._last and not self._held:
            return
        self._last = obstacles
        self.keep(obstacles)
        self._shown = {name: part for name, part in self._shown.items() if name in obstacles}
        for name, (_, part, position, rotation) in obstacles.items():
            is_round = part.kind == mujoco.mjtGeom.mjGEOM_SPHERE
            look = dict(scale=self._scale + float(part.corners.max()), disable_rotations=is_round, opacity=0.7)
            self.put(name, f"/obstacles/{name}", (position, quaternion(rotation)), **look)
            if not _look_alike(self._shown.get(name), part):
                self._shown[name], surface = part, part_triangles(part)
                node = f"/obstacles/{name}/shape"
                self._scene.add_mesh_simple(node, surface.vertices, surface.faces, color=_COLOR, opacity=0.8)


def _look_alike(one: Part | None, other: Part) -> bool:
    same = one is not None and one.kind == other.kind and np.array_equal(one.size, other.size)
    return same and np.array_equal(one.mesh[0] if one.mesh else (), other.mesh[0] if other.mesh else ())  # pyright: ignore
