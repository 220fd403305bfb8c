"""Page of ``osik view`` for a robot, with its default tasks and stance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._errors import warn
from ...limits import Limit
from ...robot import Robot
from ...robot._guesses import find_hands
from ...robot._mujoco import model_bodies, mujoco_frame_pose, mujoco_poses
from ...schemes import WeightedQP
from ...tasks import ComTask, FrameTask, PostureTask, SupportPolygon, Task, support_polygon
from ...tasks._leaves import angle_scale
from .._crouch import crouched
from .._parts import RobotParts, lowest_points, robot_parts
from ._desk import Session
from ._page import LiveView
from ._surfaces import part_triangles

_GAIN = 15.0
"""Gain of the default tasks [1/s]."""
WEIGHTS = {"foot": 1e4, "balance": 1e3, "waist": 1e2, "com": 1e2, "hand": 1e2, "posture": 1e-2}
"""Weights of the default tasks in the weighted scheme; the other schemes use priorities."""
_SOLE = 0.006
"""Height above a foot's lowest point up to which its points count as sole [m]."""
_MARGIN = 0.01
"""Margin of the support polygon inside the soles' edge [m]."""
_CORNERS = 8
"""Number of polygon corners for each sole: points of the sole, so the polygon is never larger than the soles."""


def open_robot(
    robot: Robot, source: str, feet: Sequence[str], *, limits: tuple[Limit, ...] = (), host: str, port: int
) -> LiveView:
    """Open a page with a robot to drag; ``feet`` are the frames that stand on the ground."""
    for foot in feet:
        robot.tree.frame(foot)
    shapes, look = robot_parts(robot), robot.holder.look
    if look is not None and look.read.missing:
        warn(f"the page does without mesh files that cannot be read: {', '.join(look.read.missing[:3])}")
    q = standing(robot, shapes, feet) if robot.floating_base else np.asarray(robot.q0)
    polygon = sole_polygon(robot, shapes, q, feet) if feet else None
    session = default_session(robot, q=jnp.asarray(q), feet=feet, polygon=polygon, limits=limits, source=source)
    return LiveView(session, host=host, port=port)


def default_session(
    robot: Robot,
    *,
    q: Float[Array, " nq"] | None = None,
    feet: Sequence[str] = (),
    polygon: SupportPolygon | None = None,
    limits: tuple[Limit, ...] = (),
    source: str | None = None,
    dt: float = 0.005,
) -> Session:
    """Return the default session of a robot; waist and centre of mass are offered but switched off.

    It starts at ``q`` (default: ``robot.q0``) with ``feet`` on the ground and its centre of mass over ``polygon``.
    """
    start = robot.q0 if q is None else q
    flat = "pose" if len(feet) <= 2 else "position"
    tasks: dict[str, Task] = {
        foot: FrameTask(robot, foot, rows=flat, weight=WEIGHTS["foot"], orientation_weight=1.0).at(robot, start)
        for foot in feet
    }
    if polygon is not None:
        tasks["balance"] = ComTask(robot, polygon=polygon, weight=WEIGHTS["balance"], gain=_GAIN, priority=2)
    own: Any = dict(gain=_GAIN, priority=3)
    for name in find_hands(robot):
        hand = FrameTask(robot, name, rows="position" if feet else "pose", weight=WEIGHTS["hand"], **own)
        tasks[name] = hand.at(robot, start)
    offered: dict[str, Task] = {}
    if robot.floating_base:
        waist = robot.tree.body_names[robot.tree.root]
        offered[waist] = FrameTask(robot, waist, weight=WEIGHTS["waist"], **own).at(robot, start)
        offered["centre of mass"] = ComTask(robot, weight=WEIGHTS["com"], **own).at(robot, start)
    weight = WEIGHTS["posture"] * angle_scale(robot)
    tasks |= offered | {"posture": PostureTask(robot, target=start, weight=weight, gain=1.0, priority=4)}
    return Session(
        robot=robot,
        tasks=tasks,
        scheme=WeightedQP(),
        limits=limits,
        dt=dt,
        q=np.asarray(start),
        off=frozenset(offered),
        source=source,
    )


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
