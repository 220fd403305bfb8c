"""Surroundings of the robot in a page: floor, light, sky and the first camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from .._stage import TO_LAMP, frame_camera

if TYPE_CHECKING:
    from viser import ViserServer

_AZIMUTH, _ELEVATION, _VIEW_ANGLE = 32.0, 16.0, 32.0
"""Angles of the initial camera [deg]."""
_FLOOR, _LINE, _SECTION = (232, 236, 242), (217, 223, 231), (201, 209, 219)


def add_surroundings(server: ViserServer, seen: Float[np.ndarray, "n 3"], floor: float, *, panel: bool = True) -> None:
    """Add floor at a height [m], lights, and a camera that sees the points [m] beside the panel."""
    scene, size = server.scene, float(np.linalg.norm(np.ptp(seen, axis=0)))
    middle = 0.5 * (seen.min(0) + seen.max(0))
    scene.set_up_direction("+z")
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(176, 180, 188), intensity=2.2)
    scene.add_light_directional(
        "/light/lamp", intensity=1.8, cast_shadow=True, position=tuple(middle + 3.0 * max(size, 0.5) * TO_LAMP)
    )
    scene.configure_fog(near=9.0 * size, far=28.0 * size, color=(255, 255, 255))
    cell = 10.0 ** np.floor(np.log10(max(size, 1e-3))) / 4.0
    scene.add_grid(
        "/floor",
        plane="xy",
        width=40.0 * size,
        height=40.0 * size,
        position=(float(middle[0]), float(middle[1]), floor),
        cell_size=cell,
        cell_thickness=0.8,
        cell_color=_LINE,
        section_size=4.0 * cell,
        section_thickness=1.2,
        section_color=_SECTION,
        fade_distance=14.0 * size,
        fade_strength=1.5,
        plane_color=_FLOOR,
        plane_opacity=1.0,
        shadow_opacity=0.32,
    )
    _place_camera(server, seen, 0.72 if panel else 0.94)


def _place_camera(server: ViserServer, seen: Float[np.ndarray, "n 3"], right: float) -> None:
    """Place a visitor's initial camera in front and above; ``right`` is the right end of the visible part (0 to 1)."""
    angle = np.deg2rad(_VIEW_ANGLE)
    lens = 0.5 / np.tan(0.5 * angle)
    camera = frame_camera(seen, (3, 2), _AZIMUTH, _ELEVATION, window=(0.06, right, 0.1, 0.9), lens=float(lens))
    start = server.initial_camera
    start.position, start.look_at, start.up, start.fov = camera.eye, np.asarray(camera.center), (0, 0, 1), angle
