"""Heading of a robot at home, from the names of its left and right side."""

from __future__ import annotations

import re

import numpy as np

from ..kinematics._home import home_kinematics
from ..robot import Robot

_LEFT = re.compile(r"(?i:left)|^[lL](?=[_A-Z0-9])|[_.][lL](?:$|[_.])")
_RIGHT = re.compile(r"(?i:right)|^[rR](?=[_A-Z0-9])|[_.][rR](?:$|[_.])")


def by_name(names: list[str]) -> list[str]:
    """Return two names with the left one first if the names tell the sides; else unchanged."""
    left, right = ([bool(pattern.search(name)) for name in names] for pattern in (_LEFT, _RIGHT))
    return names[::-1] if left == [False, True] and right == [True, False] else names


def facing_x(robot: Robot, left: str, right: str) -> Robot:
    """Return the robot with its home rotated by quarter turns about the vertical, so that its left points along y.

    Args:
        robot: with a free base.
        left: name of a frame on its left side.
        right: name of the mirrored frame on its right side.
    """
    kinematics = home_kinematics(robot)
    across = np.asarray(kinematics.frame_pose(robot, left)[0] - kinematics.frame_pose(robot, right)[0])
    quarters = round(float(np.arctan2(across[1], across[0])) / (0.5 * np.pi)) - 1
    if quarters % 4 == 0:
        return robot
    angle, q = -0.25 * np.pi * quarters, np.array(robot.q0)
    at = robot.tree.qpos_address[robot.tree.free_bases[0]]
    c, s, (w, x, y, z) = np.cos(angle), np.sin(angle), q[at + 3 : at + 7]
    q[at : at + 2] = np.array([[c * c - s * s, -2.0 * c * s], [2.0 * c * s, c * c - s * s]]) @ q[at : at + 2]
    q[at + 3 : at + 7] = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
    return robot.with_home(q)
