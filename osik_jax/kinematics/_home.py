"""Kinematics at a robot's home configuration, compiled once for each tree."""

from __future__ import annotations

from ..robot import Robot
from . import Kinematics, forward_kinematics


def home_kinematics(robot: Robot) -> Kinematics:
    """Return the kinematics at the robot's home configuration."""
    return forward_kinematics(robot, robot.q0)
