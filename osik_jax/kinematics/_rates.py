"""Derivatives of the kinematics along the velocity."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..robot import Robot
from ..robot._tree import BALL, FREE, KinematicTree
from ._forward import Kinematics, independent_columns
from ._joints import dof_kinds
from ._rigid import cross


def kinematics_rates(robot: Robot, kinematics: Kinematics) -> Kinematics:
    """Return the derivative of ``forward_kinematics`` along v: each field with a last axis of length nv.

    It equals the derivative by autodiff, computed from the known motion axes. A body moves with every dof above it. An
    axis and its anchor move with every dof of the joints before them.
    """
    tree = robot.tree
    kinds, number = dof_kinds(tree)
    in_world = (kinds == FREE) & (number < 3)  # a free joint's translations are along the world's axes
    axes, anchors = _movers(tree)
    rates = Kinematics(
        _velocity(kinematics, kinematics.body_position, tree.moves),
        _turning(kinematics, kinematics.body_rotation, tree.moves),
        _turning(kinematics, kinematics.dof_linear[..., None], axes & ~in_world[:, None])[:, :, 0],
        _turning(kinematics, kinematics.dof_angular[..., None], axes)[:, :, 0],
        _velocity(kinematics, kinematics.dof_anchor, anchors),
    )
    return jax.tree.map(partial(independent_columns, tree), rates)


def _movers(tree: KinematicTree) -> tuple[Bool[np.ndarray, "nvfull nvfull"], Bool[np.ndarray, "nvfull nvfull"]]:
    """Return which dofs (columns) rotate the axis of each dof, and which move its anchor.

    The axes of hinges and slides move with the joints before them; the axes of ball and free joints are those of the
    body itself. A free joint's anchor is its body's origin.
    """
    kinds, _ = dof_kinds(tree)
    joint = tree.dof_joint
    above = tree.moves[tree.dof_body]
    before = above & (joint[None, :] < joint[:, None])
    own = (joint[None, :] == joint[:, None]) & (kinds == FREE)[:, None]
    return np.where(np.isin(kinds, (BALL, FREE))[:, None], above, before), before | own


def _velocity(
    kinematics: Kinematics, points: Float[Array, "k 3"], moved: Bool[np.ndarray, "k nvfull"]
) -> Float[Array, "k 3 nvfull"]:
    """Return the velocity of points at unit speed of each dof that moves them."""
    axis = kinematics.dof_angular.T
    velocity = kinematics.dof_linear.T + cross(axis, points[:, :, None] - kinematics.dof_anchor.T, along=-2)
    return jnp.where(moved[:, None, :], velocity, 0.0)


def _turning(
    kinematics: Kinematics, vectors: Float[Array, "k 3 n"], turned: Bool[np.ndarray, "k nvfull"]
) -> Float[Array, "k 3 n nvfull"]:
    """Return the rate of column vectors at unit speed of each dof that rotates them."""
    axis = kinematics.dof_angular.T[None, :, None, :]
    return jnp.where(turned[:, None, None, :], cross(axis, vectors[..., None], along=1), 0.0)
