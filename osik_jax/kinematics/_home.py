"""Kinematics computed on the host, where nothing is compiled: at a robot's home configuration, for default targets."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from ..numerics._host import Numbers, is_traced
from ..robot import Robot
from ..robot._configuration import check_configuration
from ..robot._made_for import check_robot
from . import Kinematics, forward_kinematics
from ._forward import kinematics_at


def home_kinematics(robot: Robot) -> Kinematics:
    """Return the kinematics at the robot's home configuration: arrays of NumPy, unless the robot is traced."""
    return kinematics_on_host(robot, robot.q0)


def kinematics_on_host(robot: Robot, q: Float[Numbers, " nq"]) -> Kinematics:
    """Return ``forward_kinematics`` as arrays of NumPy, or of JAX if the robot or q is traced."""
    if is_traced((robot, q)):
        return forward_kinematics(robot, q)
    check_robot(robot, "forward_kinematics(robot, q)")
    check_configuration(robot, q, "q")
    host = jax.tree.map(lambda leaf: np.asarray(leaf, float), robot)
    found = kinematics_at(host, np.asarray(q, float))
    return jax.tree.map(lambda leaf: leaf.astype(robot.q0.dtype), found)
