"""Collision shapes of links in a live view: a capsule or a box around the visual shape of each link."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...collision import CollisionShape
from ...robot import Robot
from ...robot._mujoco import home_poses, model_bodies
from .._parts import RobotParts
from ._surfaces import part_triangles

SUFFIX = "_shape"
_SMALL = 0.015
"""Share of the robot's size below which links, such as fingers, get no shape."""
_BOX = 0.7
"""Volume ratio of box to capsule below which the box is used; capsules are faster."""


def link_covers(robot: Robot, shapes: RobotParts) -> dict[str, CollisionShape]:
    """Return a shape around each moving link, fixed to it and named like it plus ``SUFFIX``."""
    clouds, size = _clouds(robot, shapes)
    large = {body: points for body, points in clouds.items() if np.linalg.norm(np.ptp(points, axis=0)) > _SMALL * size}
    return {body + SUFFIX: _cover(points, body) for body, points in large.items()}


def _clouds(robot: Robot, shapes: RobotParts) -> tuple[dict[str, Float[np.ndarray, "k 3"]], float]:
    """Return the visual shape's points of each moving body in its frame [m], and the size of the robot [m]."""
    data = home_poses(robot)
    weld, own = shapes.model.body_weldid, model_bodies(robot)
    names = {int(weld[body]): name for name, body in zip(robot.tree.body_names, own, strict=True) if weld[body] == body}
    found: dict[int, list[np.ndarray]] = {}
    for part, body, place, turn in zip(shapes.parts, shapes.bodies, *shapes.poses(data), strict=True):
        if weld[body] in names and weld[body]:
            found.setdefault(int(weld[body]), []).append(part_triangles(part).vertices @ turn.T + place)
    everything = np.concatenate([points for group in found.values() for points in group])
    clouds = {
        names[body]: (np.concatenate(groups) - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        for body, groups in found.items()
    }
    return clouds, float(np.linalg.norm(np.ptp(everything, axis=0)))


def _cover(points: Float[np.ndarray, "k 3"], frame: str) -> CollisionShape:
    """Return the smaller of a capsule along a principal axis and a box along all principal axes."""
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    own = (points - middle) @ axes.T
    low, high = own.min(0), own.max(0)
    own, center = own - 0.5 * (low + high), middle + 0.5 * (low + high) @ axes
    # flat links get a half thickness of 1 mm
    half = np.maximum(0.5 * (high - low), 1e-3)
    fits = [_capsule(own, along) for along in range(3)]
    along = int(np.argmin([volume for *_, volume in fits]))
    radius, reach, volume = fits[along]
    # 8 a b c is the volume of a box with these half lengths
    if 8.0 * np.prod(half) < _BOX * volume:
        return CollisionShape.box(half, center, axes.T, frame=frame)
    end = max(reach, 1e-3) * axes[along]
    return CollisionShape.capsule(radius, center - end, center + end, frame=frame)


def _capsule(points: Float[np.ndarray, "k 3"], along: int) -> tuple[float, float, float]:
    """Return radius [m], half length [m] and volume of a capsule around points, along an axis through their middle."""
    off = np.linalg.norm(np.delete(points, along, axis=1), axis=1)
    radius = max(float(off.max()), 1e-3)
    reach = max(float(np.max(np.abs(points[:, along]) - np.sqrt(np.maximum(radius**2 - off**2, 0.0)))), 0.0)
    return radius, reach, np.pi * radius**2 * (2.0 * reach + 4.0 / 3.0 * radius)
