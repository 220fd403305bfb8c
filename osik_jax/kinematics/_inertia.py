"""Mass matrix and centroidal momentum, from the inertias of what hangs below each dof."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..robot import Robot
from ._forward import Kinematics, center_of_mass, independent_columns
from ._rigid import compose, cross, rotate


class Momenta(NamedTuple):
    """Of each dof at unit speed, all else at rest. World axes, angular about the robot's centre of mass."""

    velocity: Float[Array, "nvfull 3"]  # of the point of what it moves that is at the centre of mass [m/s]
    linear: Float[Array, "nvfull 3"]  # [kg m/s]
    angular: Float[Array, "nvfull 3"]  # [kg m^2/s]


def mass_matrix(robot: Robot, kinematics: Kinematics) -> Float[Array, "nv nv"]:
    """The inertia matrix M of the robot over v: its kinetic energy is ``v' M v / 2`` [J].

    With the inertia of drives (``robot.dof_armature``), as in MuJoCo. Followers carry theirs to their leaders, locked
    joints move with what carries them. Symmetric; positive definite where every motion moves some mass.

    Composite bodies (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.2), all dofs at once.
    """
    momenta = _momenta(robot, kinematics)
    carries = jnp.asarray(robot.tree.moves[robot.tree.dof_body])  # [i, j]: dof j moves the body of dof i
    products = jnp.matmul(momenta.linear, momenta.velocity.T, precision="highest")
    products = products + jnp.matmul(momenta.angular, kinematics.dof_angular.T, precision="highest")
    full = jnp.where(carries, products, jnp.where(carries.T, products.T, 0.0)) + jnp.diag(robot.dof_armature)
    return independent_columns(robot.tree, independent_columns(robot.tree, full).T)


def centroidal_momentum_matrix(robot: Robot, kinematics: Kinematics) -> Float[Array, "6 nv"]:
    """A with A v = [linear; angular] momentum [kg m/s; kg m^2/s], angular about the centre of mass, in world axes.

    The linear rows are the robot's mass times ``com_jacobian``. Drives (``robot.dof_armature``) do not count, as in
    MuJoCo and Pinocchio (D. Orin, A. Goswami, S.-H. Lee, "Centroidal dynamics of a humanoid robot", Autonomous Robots
    35, 2013).
    """
    momenta = _momenta(robot, kinematics)
    return independent_columns(robot.tree, jnp.concatenate([momenta.linear, momenta.angular], -1).T)


def _momenta(robot: Robot, kinematics: Kinematics) -> Momenta:
    center = center_of_mass(robot, kinematics)
    turn, mass = kinematics.body_rotation, robot.body_mass
    arm = kinematics.body_position + rotate(turn, robot.body_com) - center
    moment = mass[:, None] * arm
    steiner = jnp.sum(moment * arm, -1)[:, None, None] * jnp.eye(3, dtype=arm.dtype) - moment[:, :, None] * arm[:, None]
    inertia = compose(compose(turn, robot.body_inertia), turn.mT) + steiner
    parts = jnp.concatenate([mass[:, None], moment, inertia.reshape(-1, 9)], -1)
    carried = jnp.asarray(robot.tree.moves.T, parts.dtype)
    below = jnp.matmul(carried, parts, precision="highest")
    mass_below, moment_below, inertia_below = below[:, :1], below[:, 1:4], below[:, 4:].reshape(-1, 3, 3)
    axis = kinematics.dof_angular
    velocity = kinematics.dof_linear + cross(axis, center - kinematics.dof_anchor)
    linear = mass_below * velocity + cross(axis, moment_below)
    return Momenta(velocity, linear, rotate(inertia_below, axis) + cross(moment_below, velocity))
