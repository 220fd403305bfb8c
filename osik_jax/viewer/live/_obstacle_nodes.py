"""Obstacles in a page, each with a draggable handle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ...robot.loading._mjmodel import quaternion, rotation_matrix
from ._gizmos import Handles, Pose
from ._obstacles import Obstacle

if TYPE_CHECKING:
    from viser import SceneApi

_COLOR = (231, 126, 34)


class ObstacleNodes(Handles):
    """Obstacles as nodes of a page's scene, with handles to drag, turn and resize them."""

    def __init__(self, scene: SceneApi, size: float, move: Callable[..., None]) -> None:
        """Take the size of the robot [m] and ``move(obstacle, position=, rotation=)``, which a drag calls."""

        def dragged(name: str, pose: Pose, *_: object) -> None:
            move(name, position=pose[0], rotation=rotation_matrix(pose[1]))

        super().__init__(scene, dragged)
        self._scale = 0.1 * size
        self._sizes: dict[str, Float[np.ndarray, "3"]] = {}
        self._last: Mapping[str, Obstacle] | None = None

    def show(self, obstacles: Mapping[str, Obstacle]) -> None:
        """Show these obstacles and remove others."""
        if obstacles is self._last and not self._held:
            return
        self._last = obstacles
        self.keep(obstacles)
        self._sizes = {name: size for name, size in self._sizes.items() if name in obstacles}
        for name, one in obstacles.items():
            look = dict(scale=self._scale + float(np.max(one.size)), disable_rotations=one.kind == "ball", opacity=0.7)
            self.put(name, f"/obstacles/{name}", (one.position, quaternion(one.rotation)), **look)
            if not np.array_equal(self._sizes.get(name, ()), one.size):
                self._draw(one)
                self._sizes[name] = one.size

    def _draw(self, one: Obstacle) -> None:
        """Draw the shape as a child of its handle."""
        name = f"/obstacles/{one.name}/shape"
        if one.kind == "ball":
            self._scene.add_icosphere(name, radius=float(one.size[0]), color=_COLOR, opacity=0.8)
        else:
            self._scene.add_box(name, dimensions=tuple(2.0 * one.size), color=_COLOR, opacity=0.8)
