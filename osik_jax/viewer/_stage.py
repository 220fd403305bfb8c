"""Camera, and a MuJoCo model of the scene: movable copies of robots' shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ._parts import Part, RobotParts

LENS = 3.6
"""Distance of the camera in picture heights."""

TO_LAMP = np.array([0.42, -0.38, 0.82]) / np.linalg.norm([0.42, -0.38, 0.82])


@dataclasses.dataclass(frozen=True)
class Camera:
    """Pinhole camera that looks at a point."""

    center: tuple[float, float, float]  # what it looks at [m]. (3,)
    distance: float  # from there to the lens [m]
    azimuth: float  # of the lens about the vertical, 0 from +x [deg]
    elevation: float  # of the lens above the horizon [deg]
    height: float  # of what it sees at the centre, top to bottom of the picture [m]

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Return the camera's right, up and forward axes in the world as rows. (3, 3)."""
        azimuth, elevation = np.deg2rad([self.azimuth, self.elevation])
        forward = -np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def eye(self) -> Float[np.ndarray, "3"]:
        """Return the position of the camera [m]."""
        return np.asarray(self.center) - self.distance * self.axes[2]

    def rays(self, pixels: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> Float[np.ndarray, "n 3"]:
        """Return unit directions through pixel positions of a picture (width, height); x right, y down."""
        width, height = size
        scale = self.height / height
        right = (pixels[:, 0] - 0.5 * width) * scale
        up = (0.5 * height - pixels[:, 1]) * scale
        rays = np.stack([right, up, np.full_like(right, self.distance)], -1) @ self.axes
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def project(self, points: Float[np.ndarray, "*n 3"], size: tuple[int, int]) -> Float[np.ndarray, "*n 2"]:
        """Return the pixel coordinates of points of the world [m] in a picture of (width, height)."""
        width, height = size
        right, up, depth = np.moveaxis((np.asarray(points) - self.eye) @ self.axes.T, -1, 0)
        scale = self.distance / depth * height / self.height
        return np.stack([0.5 * width + right * scale, 0.5 * height - up * scale], -1)


def frame_camera(
    points: Float[np.ndarray, "n 3"],
    size: tuple[int, int],
    azimuth: float,
    elevation: float,
    window: tuple[float, float, float, float] = (0.04, 0.96, 0.06, 0.94),
    lens: float = LENS,
) -> Camera:
    """Return the nearest camera that sees all points [m] within a window of its picture.

    The window is left, right, top and bottom as parts of the picture. ``lens`` is how far the camera is, in heights of
    what it sees at its centre; farther means less perspective.
    """
    left, right, top, bottom = window
    axes = Camera((0.0, 0.0, 0.0), 1.0, azimuth, elevation, 1.0).axes
    across, up, deep = axes @ np.asarray(points).T
    middle = 0.5 * (deep.min() + deep.max())
    behind = (deep - middle) / lens
    aspect = size[0] / size[1]
    sides = ((left - 0.5) * aspect, (right - 0.5) * aspect), (0.5 - bottom, 0.5 - top)
    # With the camera's centre at c, a point is seen at (x - c) / (height + behind), in heights of the picture. So it is
    # between two sides where c lies between x - side * (height + behind) of them, which is linear in the height.
    spans = [
        (np.max(x - high * behind), np.min(x - low * behind))
        for x, (low, high) in zip((across, up), sides, strict=True)
    ]
    tall = max((most - least) / (high - low) for (most, least), (low, high) in zip(spans, sides, strict=True))
    # the camera stays in front of the nearest point, with half as much again
    height = float(max(tall, -1.5 * behind.min(), 1e-9))
    x, y = (
        0.5 * (most - high * height + least - low * height)
        for (most, least), (low, high) in zip(spans, sides, strict=True)
    )
    center = np.array([x, y, middle]) @ axes
    return Camera((float(center[0]), float(center[1]), float(center[2])), lens * height, azimuth, elevation, height)


class Stage:
    """Scene of robots' shapes on mocap bodies.

    Attributes:
        model: the MuJoCo model.
        parts: of all robots; the part k is on the body k + 1.
        colors: of each geom, red, green and blue. (geoms, 3)
    """

    def __init__(self, robots: Sequence[RobotParts]) -> None:
        """Build the model."""
        self._robots = tuple(robots)
        self.parts = tuple(part for robot in robots for part in robot.parts)
        spec = mujoco.MjSpec()
        for part in self.parts:
            _add_part(spec, part)
        self.model = spec.compile()
        self.colors = np.array([part.color[:3] for part in self.parts]).reshape(-1, 3)

    def pose(
        self, poses: Sequence[mujoco.MjData], offsets: Float[np.ndarray, "robots 3"] | None = None
    ) -> mujoco.MjData:
        """Move each robot's shapes to the poses of its own ``mj_kinematics``, shifted by its offset [m]."""
        data = mujoco.MjData(self.model)
        shift = np.zeros((len(self._robots), 3)) if offsets is None else offsets
        start = 0
        for robot, source, move in zip(self._robots, poses, shift, strict=True):
            for position, rotation in zip(*robot.poses(source), strict=True):
                data.mocap_pos[start] = position + move
                mujoco.mju_mat2Quat(data.mocap_quat[start], rotation.ravel())
                start += 1
        mujoco.mj_kinematics(self.model, data)
        return data


def _add_part(spec: mujoco.MjSpec, part: Part) -> None:
    body = spec.worldbody.add_body(mocap=True)
    if part.mesh is None:
        body.add_geom(type=part.kind, size=part.size, rgba=part.color, contype=0, conaffinity=0)
        return
    name = f"mesh{len(spec.meshes)}"
    vertices, faces = part.mesh
    mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # the others want a closed surface
    body.add_geom(type=part.kind, meshname=name, rgba=part.color, contype=0, conaffinity=0)
