"""Heading of a robot at home, from the names of its left and right side."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..kinematics._forward import home_kinematics
from ..robot import Robot

_LEFT = re.compile(r"(?i:left)|^[lL](?=[_A-Z0-9])|[_.][lL](?:$|[_.])")
_RIGHT = re.compile(r"(?i:right)|^[rR](?=[_A-Z0-9])|[_.][rR](?:$|[_.])")


def by_name(names: list[str]) -> list[str]:
    """Return two names with the left one first if the names tell the sides; else unchanged."""
    left, right = ([bool(pattern.search(name)) for name in names] for pattern in (_LEFT, _RIGHT))
    return names[::-1] if left == [False, True] and right == [True, False] else names


def facing_at_home(robot: Robot, across: tuple[str, str] | None) -> Float[np.ndarray, "3 3"]:
    """Return the axes of a robot at home, forward, left and up as columns, to a quarter turn about the vertical.

    ``across`` has a frame of its left side, and one of its right side; with None it faces x.
    """
    if across is None:
        return np.eye(3)
    kinematics = home_kinematics(robot)
    left = np.asarray(kinematics.frame_pose(robot, across[0])[0] - kinematics.frame_pose(robot, across[1])[0])
    quarters = round(float(np.arctan2(left[1], left[0])) / (0.5 * np.pi)) - 1
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters % 4]
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], float)


def facing_x(robot: Robot, across: tuple[str, str] | None) -> Robot:
    """Return the robot with its home rotated by quarter turns about the vertical, so that its left points along y.

    A robot with a fixed base stays as it is.
    """
    facing = facing_at_home(robot, across)
    if not robot.floating_base or (facing == np.eye(3)).all():
        return robot
    q, at = np.array(robot.q0), robot.tree.qpos_address[robot.tree.free_bases[0]]
    back = Rotation.from_matrix(facing.T)
    q[at : at + 3] = facing.T @ q[at : at + 3]
    turned = back * Rotation.from_quat(q[at + 3 : at + 7], scalar_first=True)
    q[at + 3 : at + 7] = turned.as_quat(scalar_first=True)
    return robot.with_home(q)
