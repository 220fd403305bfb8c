"""Marks of balance: support polygon, centre of mass and its projection on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ...tasks import SupportPolygon

if TYPE_CHECKING:
    from viser import SceneApi

_IN, _OUT, _EDGE = (42, 157, 98), (215, 38, 61), (28, 111, 184)
_LIFT = 0.002
"""Height of flat marks above the floor [m]."""
_TOUCHING = 1e-3
"""Distance beyond a polygon's edge up to which a point counts as inside [m]."""


class BalanceMarks:
    """Support polygon, and the centre of mass as a ball with a disc on the floor; green inside, red outside."""

    def __init__(self, scene: SceneApi, floor: float, size: float) -> None:
        """Take the height of the floor and the size of the robot [m]."""
        self._scene, self._floor, self._size = scene, floor, size
        self._polygon: SupportPolygon | None = None
        self._color: tuple[int, int, int] | None = None
        self._at = np.full(3, np.inf)

    def show_polygon(self, polygon: SupportPolygon | None) -> None:
        """Draw the polygon; None removes it."""
        self._polygon, self._color = polygon, None
        self._scene.remove_by_name("/balance/area")
        self._scene.remove_by_name("/balance/edge")
        if polygon is None:
            return
        corners = np.c_[np.asarray(polygon.vertices), np.full(len(polygon.vertices), self._floor + _LIFT)]
        fan = np.array([[0, k, k + 1] for k in range(1, len(corners) - 1)])
        self._scene.add_mesh_simple(
            "/balance/area", corners, fan, color=_EDGE, opacity=0.22, cast_shadow=False, side="double"
        )
        ring = np.stack([corners, np.roll(corners, -1, 0)], 1)
        self._scene.add_line_segments("/balance/edge", ring, _EDGE, thickness=2.5, thickness_units="screen")

    def place(self, com: Float[np.ndarray, "3"]) -> None:
        """Move the centre of mass [m]."""
        inside = self._polygon is None or float(self._polygon.distance(com[:2])) > -_TOUCHING
        color = _IN if inside else _OUT
        if color != self._color:
            self._color = color
            self._draw(com, color)
        # smaller motions are invisible and need no message to the page
        elif np.abs(com - self._at).max() > 1e-5:
            self._ball.position = com
            self._disc.position = (com[0], com[1], self._floor + 2.0 * _LIFT)
        self._at = np.array(com)

    def _draw(self, com: np.ndarray, color: tuple[int, int, int]) -> None:
        radius = 0.016 * self._size
        self._ball = self._scene.add_icosphere(
            "/balance/com", radius=radius, color=color, opacity=0.75, cast_shadow=False, position=com
        )
        self._disc = self._scene.add_cylinder(
            "/balance/below",
            radius=radius,
            height=_LIFT,
            color=color,
            cast_shadow=False,
            position=(com[0], com[1], self._floor + 2.0 * _LIFT),
        )
