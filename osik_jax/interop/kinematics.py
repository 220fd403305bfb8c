"""Kinematics of other libraries in place of our own, for comparison and for robots of other libraries."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..kinematics._joints import dof_kinds
from ..kinematics._rigid import cross
from ..robot import Robot
from ..robot._tree import BALL, FREE, SLIDE


def kinematics_from(
    robot: Robot,
    position: Float[Array, "nbody 3"],
    rotation: Float[Array, "nbody 3 3"],
    jacobian: Float[Array, "nbody 6 nv"],
) -> Kinematics:
    """Return the kinematics equivalent to another library's forward kinematics and Jacobians.

    Tasks and limits take the result like that of ``forward_kinematics``; a control step is
    ``scheme.solve(build_problem(robot, q, tasks, kinematics=kinematics))``. The axis of each dof is read from the
    Jacobian of the body that it moves first: a column ``[l; w]`` at the body's origin p is a translation along l if w
    is 0, and else a turn about the axis w through ``p + w x l``. Masses are the robot's own, so the centre of mass
    follows.

    Args:
        robot: the robot, without locked or following joints.
        position: origins of the bodies of ``robot.body_names`` in the world [m].
        rotation: from the axes of each body to the world's.
        jacobian: of each body, ``[linear; angular] = jacobian v`` in world axes, linear at the body's origin, with
            ``robot``'s velocity v: of a floating base, linear velocity in world axes, angular velocity in its own.

    Raises:
        ValueError: a wrong shape; a robot with locked or following joints.
    """
    tree = robot.tree
    if len(tree.dof_body) != robot.nv:
        raise OsikValueError("kinematics_from takes a robot without locked and following joints")
    bodies = len(robot.body_names)
    given = dict(position=position, rotation=rotation, jacobian=jacobian)
    wanted = dict(position=(bodies, 3), rotation=(bodies, 3, 3), jacobian=(bodies, 6, robot.nv))
    for name, array in given.items():
        if jnp.shape(array) != wanted[name]:
            raise OsikValueError(f"{name} has shape {jnp.shape(array)}; expected {wanted[name]}, one for each body")
    kinds, number = dof_kinds(tree)
    dofs = np.arange(robot.nv)
    own = np.asarray(tree.dof_body, int) - 1
    linear, angular = jacobian[own, :3, dofs], jacobian[own, 3:, dofs]
    turns = (kinds != SLIDE) & ~((kinds == FREE) & (number < 3))
    together = turns & np.isin(
        kinds, (BALL, FREE)
    )  # three axes through one point, of which each column gives two thirds
    same = (tree.dof_joint[:, None] == tree.dof_joint) & together
    arm = jnp.where(turns[:, None], cross(angular, linear), 0.0)
    arm = jnp.where(together[:, None], jnp.matmul(same.astype(arm.dtype), arm, precision="highest") / 2.0, arm)
    anchor = position[own] + arm
    return Kinematics(
        jnp.concatenate([jnp.zeros((1, 3), position.dtype), position]),
        jnp.concatenate([jnp.eye(3, dtype=rotation.dtype)[None], rotation]),
        jnp.where(turns[:, None], 0.0, linear),
        jnp.where(turns[:, None], angular, 0.0),
        anchor,
    )
