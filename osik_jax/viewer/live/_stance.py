"""Initial stance where the file gives none: legs slightly bent, soles flat, lowest point at height 0."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...robot import Robot
from ...robot._mujoco import model_bodies, mujoco_frame_pose, mujoco_poses
from ...tasks import SupportPolygon, support_polygon
from .._crouch import crouched
from .._outline import lowest_points
from .._parts import RobotParts
from ._surfaces import part_triangles

_SOLE = 0.006
"""Height above a foot's lowest point up to which its points count as sole [m]."""
# margin of the support polygon inside the soles' edge [m]
_MARGIN = 0.01
_CORNERS = 8
"""Number of polygon corners for each sole; corners are points of the sole, so the polygon is never larger than the
soles.
"""


def standing(robot: Robot, shapes: RobotParts, feet: Sequence[str]) -> Float[np.ndarray, " nq"]:
    """Return home with the waist slightly lowered over the feet and the robot on the ground. (nq,).

    A robot that has a keyframe is where that says.
    """
    q = np.array(robot.q0)
    if robot.mj_model.nkey:
        return q
    q = np.array(crouched(robot, feet)) if feet else q
    data = next(mujoco_poses(robot, q))
    q[robot.tree.qpos_address[robot.tree.free_bases[0]] + 2] -= lowest_points(shapes, data).min()
    return q


def sole_polygon(
    robot: Robot, shapes: RobotParts, q: Float[np.ndarray, " nq"], feet: Sequence[str]
) -> SupportPolygon | None:
    """Return the support polygon of feet; without named corners, soles are the feet's lowest points.

    None where they span no area.
    """
    named = [foot for foot in feet if f"{foot}_corner_0" in robot.frame_names]
    data = next(mujoco_poses(robot, q))
    corners = {foot: _sole(robot, shapes, data, foot) for foot in feet if foot not in named}
    try:
        return support_polygon(robot, jnp.asarray(q), tuple(feet), margin=_MARGIN, corners=corners)
    except ValueError:  # points, a line, or feet too small for the margin
        return None


def _sole(robot: Robot, shapes: RobotParts, data: object, foot: str) -> Float[np.ndarray, "k 3"]:
    """Return the lowest points of a foot, in its frame [m]."""
    body = model_bodies(robot)[robot.tree.frame_bodies[robot.tree.frame(foot)]]
    weld = shapes.model.body_weldid
    position, rotation = mujoco_frame_pose(robot, data, foot)
    clouds = [
        part_triangles(part).vertices @ turn.T + place
        for part, own, place, turn in zip(shapes.parts, shapes.bodies, *shapes.poses(data), strict=True)
        if weld[own] == weld[body]
    ]
    points = np.concatenate(clouds) if clouds else position[None]
    lowest = points[points[:, 2] < points[:, 2].min() + _SOLE]
    angle = np.arange(_CORNERS) * 2.0 * np.pi / _CORNERS
    outermost = np.argmax(lowest[:, :2] @ np.stack([np.cos(angle), np.sin(angle)]), axis=0)
    return (lowest[np.unique(outermost)] - position) @ rotation
