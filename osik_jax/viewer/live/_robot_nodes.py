"""Scene of a page: floor, lights, the first camera, and a robot as a node per body with its shapes as children."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ...robot import Robot
from ...robot._mujoco import home_poses
from .._parts import RobotParts, robot_parts
from .._stage import TO_LAMP, frame_camera
from ._surfaces import Surface, part_triangles

if TYPE_CHECKING:
    from viser import FrameHandle, SceneApi, ViserServer

_APART = 1.1
"""Distance between robots, in widths of a robot."""
_MOVED = 1e-7
"""Least change of a position [m] or quaternion that is sent to the page."""

_AZIMUTH, _ELEVATION, _VIEW_ANGLE = 32.0, 16.0, 32.0
"""Angles of the initial camera [deg]."""
_FLOOR, _LINE, _SECTION = (232, 236, 242), (217, 223, 231), (201, 209, 219)


class RobotNodes:
    """Scene nodes of one robot."""

    def __init__(
        self, scene: SceneApi, robot: Robot, *, name: str = "robot", offset: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        """Add the robot at ``robot.q0``, moved by an offset [m], as a node of this name."""
        shapes, data = robot_parts(robot), home_poses(robot)
        scene.add_frame(f"/{name}", show_axes=False, position=np.asarray(offset))
        self._frames: dict[int, FrameHandle] = {}
        for body, pieces in _by_body(shapes, data).items():
            place: Any = dict(position=data.xpos[body].copy(), wxyz=data.xquat[body].copy())
            self._frames[body] = scene.add_frame(f"/{name}/{body}", show_axes=False, **place)
            for number, (color, surface) in enumerate(pieces.items()):
                scene.add_mesh_simple(
                    f"/{name}/{body}/{number}",
                    surface.vertices,
                    surface.faces,
                    color=color[:3],
                    opacity=None if color[3] >= 255 else color[3] / 255.0,
                )
        self._bodies = np.array(list(self._frames), int)
        self._position, self._quaternion = data.xpos[self._bodies], data.xquat[self._bodies]

    def place(self, data: mujoco.MjData) -> None:
        """Move the bodies to their poses by MuJoCo's kinematics."""
        position, quaternion, frames = data.xpos[self._bodies], data.xquat[self._bodies], tuple(self._frames.values())
        for k in np.flatnonzero(np.abs(position - self._position).max(1) > _MOVED):
            frames[k].position = self._position[k] = position[k]
        for k in np.flatnonzero(np.abs(quaternion - self._quaternion).max(1) > _MOVED):
            frames[k].wxyz = self._quaternion[k] = quaternion[k]


def side_by_side(span: Float[np.ndarray, "points 3"], count: int) -> list[Float[np.ndarray, "3"]]:
    """Return the offsets [m] that place copies of a robot with these points side by side, from left to right."""
    width = _APART * float(np.ptp(span[:, 1]))
    return [np.array([0.0, (k - 0.5 * (count - 1)) * width, 0.0]) for k in range(count)]


def add_label(scene: SceneApi, name: str, span: Float[np.ndarray, "points 3"]) -> None:
    """Add a robot's name above its points [m]."""
    at, height = span[:, :2].mean(0), span[:, 2].max() + 0.05 * float(np.ptp(span[:, 1]))
    scene.add_label(f"/label {name}", name.replace("_", " "), position=(at[0], at[1], height))


def _by_body(shapes: RobotParts, data: mujoco.MjData) -> dict[int, dict[tuple[int, int, int, int], Surface]]:
    """Return the surfaces of each body by colour (0 to 255), in the body's frame."""
    from trimesh.util import append_faces  # comes with viser

    out: dict[int, dict[tuple[int, int, int, int], tuple[list[np.ndarray], list[np.ndarray]]]] = {}
    positions, rotations = shapes.poses(data)
    for part, body, position, rotation in zip(shapes.parts, shapes.bodies, positions, rotations, strict=True):
        turn = data.xmat[body].reshape(3, 3)
        own = part_triangles(part)
        vertices = (own.vertices @ rotation.T + position - data.xpos[body]) @ turn
        red, green, blue, alpha = (round(255 * float(x)) for x in np.clip(part.color, 0.0, 1.0))
        pieces = out.setdefault(int(body), {}).setdefault((red, green, blue, alpha), ([], []))
        pieces[0].append(vertices)
        pieces[1].append(own.faces)
    return {body: {color: Surface(*append_faces(*own)) for color, own in each.items()} for body, each in out.items()}


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
