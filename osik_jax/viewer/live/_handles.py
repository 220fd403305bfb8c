"""Draggable handles in a page, and the visitors who drag them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from viser import SceneApi, TransformControlsEvent, TransformControlsHandle

Pose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]
"""Position [m] and quaternion w x y z."""
_MOVED = 1e-9
"""Change of a position [m] or of a quaternion's entries below which it is rounding and is not sent to the page."""


class Handles:
    """Handles of one kind, by name."""

    def __init__(self, scene: SceneApi, dragged: Callable[[str, Pose, int, str], None]) -> None:
        """Take viser's scene and the callback of a drag: name, pose, visitor, and phase (start, update or end)."""
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
