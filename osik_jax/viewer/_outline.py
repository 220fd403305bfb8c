"""Lowest point of a robot, and its floor height."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from jaxtyping import Float

from ..robot import Robot
from ._parts import RobotParts


def lowest_points(shape: RobotParts, data: mujoco.MjData) -> Float[np.ndarray, " parts"]:
    """Return the height of each part's lowest point in the world [m]; exact for meshes, boxes and round shapes."""
    position, rotation = shape.poses(data)
    down = -rotation[:, 2]  # in each part's frame
    return position[:, 2] - np.array([part.reach(way) for part, way in zip(shape.parts, down, strict=True)])


def base_height(shape: RobotParts, heights: Float[np.ndarray, " parts"]) -> float:
    """Return the height of the lowest point of what is fixed to the world [m]; 0 where nothing of that is drawn."""
    base = heights[shape.model.body_weldid[shape.bodies] == 0]
    return float(base.min()) if len(base) else 0.0


def floor_height(robot: Robot, shape: RobotParts, poses: Iterable[mujoco.MjData]) -> float:
    """Return the floor's height [m]: a floating robot's lowest point in the first frame, or its base's height.

    Where a robot that is bolted down reaches below its base, the floor is under the lowest point of all poses.
    """
    first, *others = (lowest_points(shape, data) for data in poses)
    if robot.floating_base:
        return float(first.min())
    return min(base_height(shape, first), *(float(heights.min()) for heights in (first, *others)))
