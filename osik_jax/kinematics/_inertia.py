"""Mass matrix and centroidal momentum, from composite inertias."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..robot import Robot
from ._forward import Kinematics, body_masses, center_of_mass, check_kinematics, independent_columns
from ._rigid import compose, cross, rotate


class Momenta(NamedTuple):
    """Centre, linear and angular momentum of the bodies that each dof carries, at unit speed; world axes."""

    center: Float[Array, "nvfull 3"]  # of mass [m]
    linear: Float[Array, "nvfull 3"]  # [kg m/s]
    angular: Float[Array, "nvfull 3"]  # about that centre [kg m^2/s]


def mass_matrix(robot: Robot, kinematics: Kinematics) -> Float[Array, "nv nv"]:
    """Return the inertia matrix M of the robot over v: its kinetic energy is ``v' M v / 2`` [J].

    It includes the inertia of drives (``robot.dof_armature``), as in MuJoCo. That of followers is added to their
    leaders; locked joints are rigid. It is symmetric, and positive definite if every motion moves some mass.

    Method: composite bodies (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.2), all dofs at once.
    """
    check_kinematics(robot, kinematics)
    momenta = _momenta(robot, kinematics)
    axis = kinematics.dof_angular
    velocity = kinematics.dof_linear + cross(axis, momenta.center[:, None] - kinematics.dof_anchor)
    products = jnp.sum(momenta.linear[:, None] * velocity + momenta.angular[:, None] * axis, -1)
    carries = jnp.asarray(robot.tree.moves[robot.tree.dof_body])  # [i, j]: dof j moves what dof i does
    full = jnp.where(carries, products, jnp.where(carries.T, products.T, 0.0)) + jnp.diag(robot.dof_armature)
    return independent_columns(robot.tree, independent_columns(robot.tree, full).T)


def centroidal_momentum_matrix(robot: Robot, kinematics: Kinematics) -> Float[Array, "6 nv"]:
    """Return the matrix A with A v = [linear; angular] momentum [kg m/s; kg m^2/s].

    World axes; the angular momentum is about the centre of mass.

    Raises:
        ValueError: the scene has several trees that may be the robot.
    """
    check_kinematics(robot, kinematics)
    robot = _without_scene(robot)
    momenta = _momenta(robot, kinematics)
    angular = momenta.angular + cross(momenta.center - center_of_mass(robot, kinematics), momenta.linear)
    return independent_columns(robot.tree, jnp.concatenate([momenta.linear, angular], -1).T)


def _without_scene(robot: Robot) -> Robot:
    """Return the robot with bodies of the scene that have neither mass nor inertia."""
    own = robot.tree.is_own
    if own[1:].all():
        return robot
    inertia = jnp.where(own[:, None, None], robot.body_inertia, 0.0)
    return eqx.tree_at(lambda robot: (robot.body_mass, robot.body_inertia), robot, (body_masses(robot), inertia))


def _momenta(robot: Robot, kinematics: Kinematics) -> Momenta:
    mass, center, inertia = (of_bodies[robot.tree.dof_body] for of_bodies in _composites(robot, kinematics))
    axis = kinematics.dof_angular
    velocity = kinematics.dof_linear + cross(axis, center - kinematics.dof_anchor)
    return Momenta(center, mass[:, None] * velocity, rotate(inertia, axis))


def _composites(
    robot: Robot, kinematics: Kinematics
) -> tuple[Float[Array, " nbody"], Float[Array, "nbody 3"], Float[Array, "nbody 3 3"]]:
    """Return mass [kg], centre of mass [m] and inertia about that [kg m^2] of each body with all its descendants.

    World axes. Inertias are summed about their own centres, because far from a common point light bodies lose digits.
    """
    turn, mass = kinematics.body_rotation, robot.body_mass
    centers = kinematics.body_position + rotate(turn, robot.body_com)
    below = jnp.asarray(robot.tree.descendants, mass.dtype)
    masses = below * mass
    total = jnp.sum(masses, -1)
    heavy = total > 0.0
    moment = jnp.matmul(masses, centers - centers[robot.tree.reference_body], precision="highest")
    center = centers[robot.tree.reference_body] + moment / jnp.where(heavy, total, 1.0)[:, None]
    arm = centers - center[:, None]
    spread = jnp.sum((masses[:, :, None] * arm)[..., :, None] * arm[..., None, :], 1)
    own = compose(compose(turn, robot.body_inertia), turn.mT)
    inertia = jnp.matmul(below, own.reshape(-1, 9), precision="highest").reshape(-1, 3, 3)
    trace = jnp.trace(spread, axis1=-2, axis2=-1)[:, None, None]
    return total, center, inertia + trace * jnp.eye(3, dtype=mass.dtype) - spread
