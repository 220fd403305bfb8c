"""Robot in a page: a scene node per body, with its shapes as children."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float

from ...robot import Robot
from ...robot._mujoco import home_poses
from .._parts import RobotParts, robot_parts
from ._surfaces import Surface, part_triangles

if TYPE_CHECKING:
    from viser import FrameHandle, SceneApi

_APART = 1.1
"""Distance between robots, in widths of a robot."""
_MOVED = 1e-7
"""Least change of a position [m] or quaternion that is sent to the page."""


class RobotNodes:
    """Scene nodes of one robot."""

    def __init__(
        self,
        scene: SceneApi,
        robot: Robot,
        *,
        name: str = "robot",
        offset: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Add the robot at ``robot.q0``, moved by an offset [m], as a node of this name."""
        shapes = robot_parts(robot)
        data = home_poses(robot)
        scene.add_frame(f"/{name}", show_axes=False, position=np.zeros(3) if offset is None else offset)
        self._frames: dict[int, FrameHandle] = {}
        for body, pieces in _by_body(shapes, data).items():
            position, quaternion = data.xpos[body], data.xquat[body]
            self._frames[body] = scene.add_frame(
                f"/{name}/{body}", show_axes=False, position=position.copy(), wxyz=quaternion.copy()
            )
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


def side_by_side(span: Float[np.ndarray, "points 3"], count: int, least: float = 0.0) -> list[Float[np.ndarray, "3"]]:
    """Return the offsets [m] that place ``count`` copies of a robot with these points side by side, from left to right.

    ``least`` is the least distance of neighbours [m].
    """
    width = max(_APART * float(np.ptp(span[:, 1])), least)
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
