"""Default tasks of a live view: hands, feet, waist and centre of mass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Float

from ...kinematics import forward_kinematics
from ...robot import Robot
from ...robot._hands import find_hands
from ...schemes import WeightedQP
from ...tasks import ComTask, FrameTask, PostureTask, SupportPolygon, Task
from ...tasks._background import angle_scale
from ._session import Session
from ._source import RobotSource

# gain of the default tasks [1/s]
_GAIN = 15.0
WEIGHTS = {"foot": 1e4, "balance": 1e3, "waist": 1e2, "com": 1e2, "hand": 1e2, "posture": 1e-2}
"""Weights of the default tasks in the weighted scheme; the other schemes use priorities."""


def default_session(
    robot: Robot,
    *,
    q: Float[Array, " nq"] | None = None,
    feet: Sequence[str] = (),
    polygon: SupportPolygon | None = None,
    source: RobotSource | None = None,
    dt: float = 0.005,
) -> Session:
    """Return the default session of a robot; waist and centre of mass are offered but switched off.

    It starts at ``q`` (default: ``robot.q0``) with ``feet`` on the ground and its centre of mass over ``polygon``.
    """
    start = robot.q0 if q is None else q
    poses = forward_kinematics(robot, start)
    flat = "pose" if len(feet) <= 2 else "position"
    tasks: dict[str, Task] = {
        foot: FrameTask(robot, foot, target=pose, rows=flat, weight=WEIGHTS["foot"], orientation_weight=1.0)
        for foot, pose in ((foot, poses.frame_pose(robot, foot)) for foot in feet)
    }
    if polygon is not None:
        tasks["balance"] = ComTask(robot, polygon=polygon, weight=WEIGHTS["balance"], gain=_GAIN, priority=2)
    for name in find_hands(robot):
        pose = poses.frame_pose(robot, name)
        rows = "position" if feet else "pose"
        tasks[name] = FrameTask(robot, name, target=pose, rows=rows, weight=WEIGHTS["hand"], gain=_GAIN, priority=3)
    led: Mapping[str, Task] = _led_later(robot, start) if robot.floating_base else {}
    tasks |= led
    tasks["posture"] = PostureTask(
        robot, target=start, weight=WEIGHTS["posture"] * angle_scale(robot), gain=1.0, priority=4
    )
    return Session(
        robot=robot,
        tasks=tasks,
        scheme=WeightedQP(),
        limits=(),
        dt=dt,
        q=np.asarray(start),
        off=frozenset(led),
        source=source,
    )


def _led_later(robot: Robot, q: Float[Array, " nq"]) -> dict[str, Task]:
    """Return the tasks offered (switched off) for a floating-base robot: waist pose and centre of mass."""
    waist = robot.tree.body_names[robot.tree.root]
    task = FrameTask(robot, waist, weight=WEIGHTS["waist"], gain=_GAIN, priority=3).at(robot, q)
    com = ComTask(robot, weight=WEIGHTS["com"], gain=_GAIN, priority=3).at(robot, q)
    return {waist: task, "centre of mass": com}
