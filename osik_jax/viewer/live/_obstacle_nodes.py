"""Obstacles in a page, each with a draggable handle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from ._obstacles import Obstacle

if TYPE_CHECKING:
    from viser import SceneApi, TransformControlsEvent, TransformControlsHandle

Dragged = Callable[[str, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]], None]
"""Arguments of a drag callback: obstacle, position [m] and rotation."""
_COLOR = (231, 126, 34)
# a smaller change of an obstacle [m] is rounding and is not sent to the page
_MOVED = 1e-9


class _Shown(NamedTuple):
    """Handle and shape of one obstacle, as the page shows them."""

    handle: TransformControlsHandle
    kind: str
    size: Float[np.ndarray, "3"]


class ObstacleNodes:
    """Obstacles as nodes of a page's scene, with handles to drag, turn and resize them."""

    def __init__(self, scene: SceneApi, size: float, dragged: Dragged) -> None:
        """Take the size of the robot [m] and the drag callback."""
        self._scene, self._scale, self._dragged = scene, 0.1 * size, dragged
        self._shown: dict[str, _Shown] = {}
        self._held: dict[str, int] = {}
        self._last: Mapping[str, Obstacle] | None = None

    def show(self, obstacles: Mapping[str, Obstacle]) -> None:
        """Show these obstacles and remove others."""
        if obstacles is self._last and not self._held:
            return
        self._last = obstacles
        for name in [name for name in self._shown if name not in obstacles]:
            self._shown.pop(name).handle.remove()
            self._held.pop(name, None)
        for name, one in obstacles.items():
            shown = self._shown.get(name)
            if shown is None:
                shown = self._shown[name] = _Shown(self._handle(one), one.kind, np.zeros(3))
            elif name not in self._held:
                _move(shown.handle, one)
            if not np.array_equal(shown.size, one.size):
                self._draw(one)
                self._shown[name] = shown._replace(size=one.size)

    def drop(self, visitor: int) -> None:
        """Release everything that a visitor who left was dragging."""
        for name in [name for name, holder in self._held.items() if holder == visitor]:
            self._held.pop(name, None)

    def _handle(self, one: Obstacle) -> TransformControlsHandle:
        handle = self._scene.add_transform_controls(
            f"/obstacles/{one.name}",
            scale=self._scale + float(np.max(one.size)),
            disable_rotations=one.kind == "ball",
            depth_test=False,
            opacity=0.7,
            position=one.position,
            wxyz=_quaternion(one),
        )

        @handle.on_update
        async def _(event: TransformControlsEvent) -> None:
            if event.phase == "end":
                self._held.pop(one.name, None)
            else:
                self._held[one.name] = -1 if event.client_id is None else event.client_id
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, np.asarray(event.target.wxyz, float))
            self._dragged(one.name, np.asarray(event.target.position, float), rotation.reshape(3, 3))

        return handle

    def _draw(self, one: Obstacle) -> None:
        """Draw the shape as a child of its handle."""
        name = f"/obstacles/{one.name}/shape"
        if one.kind == "ball":
            self._scene.add_icosphere(name, radius=float(one.size[0]), color=_COLOR, opacity=0.8)
        else:
            self._scene.add_box(name, dimensions=tuple(2.0 * one.size), color=_COLOR, opacity=0.8)


def _move(handle: TransformControlsHandle, one: Obstacle) -> None:
    """Move the handle to the obstacle, if it is not there yet."""
    if np.abs(np.asarray(handle.position) - one.position).max() > _MOVED:
        handle.position = one.position
    quaternion = _quaternion(one)
    if abs(float(np.asarray(handle.wxyz) @ quaternion)) < 1.0 - _MOVED:
        handle.wxyz = quaternion


def _quaternion(one: Obstacle) -> Float[np.ndarray, "4"]:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, one.rotation.ravel())
    return quaternion
