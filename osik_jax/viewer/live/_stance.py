"""Initial stance where the file gives none: legs slightly bent, soles flat, lowest point at height 0."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...kinematics import forward_kinematics, integrate
from ...kinematics._home import home_kinematics
from ...robot import Robot
from ...robot._joint_selection import scalar_layout
from ...tasks import FrameTask, SupportPolygon, support_polygon
from .._mujoco import model_bodies, mujoco_frame_pose, mujoco_poses
from .._parts import RobotParts
from .._shapes import lowest_points
from ._surfaces import part_triangles

_SINK = 0.05
"""Share of the waist's height by which it is lowered over the feet."""
_BEND = 0.05
"""Share of the range by which joints first move towards its middle, so that knees bend to their possible side."""
_STEPS = 60
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
    q = _crouched(robot, feet) if feet else q
    data = next(mujoco_poses(robot, q))
    q[robot.tree.qpos_address[robot.tree.free_bases[0]] + 2] -= lowest_points(shapes, data).min()
    return q


def _crouched(robot: Robot, feet: Sequence[str]) -> Float[np.ndarray, " nq"]:
    """Return the configuration with the feet of home and a lower waist, by damped Gauss-Newton steps from bent legs."""
    home = home_kinematics(robot)
    waist = robot.tree.body_names[robot.tree.root]
    p, R = home.frame_pose(robot, waist)
    ground = min(float(home.frame_pose(robot, foot)[0][2]) for foot in feet)
    lower = (p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)]), R)
    tasks = [FrameTask(robot, waist, target=lower), *(FrameTask(robot, foot) for foot in feet)]
    scalar, index = scalar_layout(robot)

    @jax.jit
    def step(q: Array) -> Array:
        kinematics = forward_kinematics(robot, q)
        parts = [task.rows(robot, kinematics, q) for task in tasks]
        e, J = (jnp.concatenate([getattr(part, name) for part in parts]) for name in ("error", "jacobian"))
        # the damping keeps steps finite where legs are stretched and J loses rank
        v = -J.T @ jnp.linalg.solve(J @ J.T + 1e-6 * jnp.eye(len(e)), e)
        at = q[index]
        low = jnp.where(scalar, robot.position_lower - at, -jnp.inf)
        high = jnp.where(scalar, robot.position_upper - at, jnp.inf)
        # clipped to the limits; a joint that starts outside its range may stay but not go farther
        return integrate(robot, q, jnp.clip(v, jnp.minimum(low, 0.0), jnp.maximum(high, 0.0)), 1.0)

    q = _bent(robot)
    for _ in range(_STEPS):
        q = step(q)
    return np.array(q)


def _bent(robot: Robot) -> Float[Array, " nq"]:
    """Return home with limited joints moved slightly towards the middle of their range."""
    scalar, index = (np.asarray(part) for part in scalar_layout(robot))
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    limited = scalar & np.isfinite(lower) & np.isfinite(upper)
    lower, upper = lower[limited], upper[limited]
    v, span = np.zeros(robot.nv), upper - lower
    away = 0.5 * (lower + upper) - np.asarray(robot.q0)[index[limited]]
    v[limited] = np.clip(away, -_BEND * span, _BEND * span)
    return integrate(robot, robot.q0, jnp.asarray(v, robot.q0.dtype), 1.0)


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
