"""Targets at the robot's current pose by MuJoCo's kinematics, fast enough for the control thread."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...robot import Robot
from ...tasks import ComTask, FrameTask, PostureTask, Task
from .._mujoco import mujoco_frame_pose, mujoco_poses, robot_com


def targets_here(
    robot: Robot, q: Float[np.ndarray, " nq"], tasks: Mapping[str, Task], names: Iterable[str]
) -> dict[str, Any]:
    """Return the targets that the given tasks meet at q; tasks without a target are left out."""
    data = next(mujoco_poses(robot, q))
    found: dict[str, Any] = {}
    for name in names:
        match tasks.get(name):
            case FrameTask(frame=frame):
                found[name] = mujoco_frame_pose(robot, data, frame)
            case ComTask(target=target, axes=axes, subtree=None) if target is not None:
                found[name] = robot_com(robot, data)[["xyz".index(axis) for axis in axes]]
            case PostureTask(target=target) if target is not None:
                found[name] = np.array(q)
    return found
