"""Kinematics at a robot's home configuration, for work outside jit."""

from __future__ import annotations

import jax

from ..robot import Robot
from . import Kinematics, forward_kinematics

compiled_kinematics = jax.jit(forward_kinematics)
"""Compiled once for each tree."""


def home_kinematics(robot: Robot) -> Kinematics:
    """Return the kinematics at the robot's home configuration."""
    return compiled_kinematics(robot, robot.q0)
