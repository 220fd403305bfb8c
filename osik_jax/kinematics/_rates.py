"""Derivatives of the kinematics along the velocity."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..robot import Robot
from ..robot._tree import BALL, FREE, KinematicTree
from ._forward import Kinematics
from ._joints import dof_kinds


def kinematics_rates(robot: Robot, kinematics: Kinematics) -> Kinematics:
    """Return the derivative of ``forward_kinematics`` along v: each field with a last axis of length nv.

    It equals the derivative by autodiff, computed from the known motion axes. A body moves with every dof above it. An
    axis and its anchor move with every dof of the joints before them.
    """
    (own, _), *followers = robot.tree.dof_columns
    rates = _rates_of(robot.tree, kinematics, own)
    for dofs, coefficient in followers:
        added = _rates_of(robot.tree, kinematics, dofs)
        rates = jax.tree.map(lambda rate, more, factor=coefficient: rate + more * factor, rates, added)
    return rates


def _rates_of(tree: KinematicTree, kinematics: Kinematics, dofs: Int[np.ndarray, " n"]) -> Kinematics:
    """Return the rates at unit speed of each of some dofs alone.

    Their axes are chosen first, so that XLA computes the rates of the bodies that are used, and no others.
    """
    kinds, number = dof_kinds(tree)
    in_world = (kinds == FREE) & (number < 3)  # a free joint's translations are along the world's axes
    axes, anchors = _movers(tree)
    linear, angular, anchor = (
        a if len(dofs) == len(a) else a[dofs]
        for a in (kinematics.dof_linear, kinematics.dof_angular, kinematics.dof_anchor)
    )

    def velocity(points: Float[Array, "k 3"], moved: Bool[np.ndarray, "k nvfull"]) -> Float[Array, "k 3 n"]:
        """Return the velocity of points at unit speed of each dof that moves them."""
        found = linear.T + _cross(angular, points[:, :, None] - anchor.T)
        return jnp.where(moved[:, None, dofs], found, 0.0)

    def turning(vectors: Float[Array, "k 3 m"], turned: Bool[np.ndarray, "k nvfull"]) -> Float[Array, "k 3 m n"]:
        """Return the rate of column vectors at unit speed of each dof that rotates them."""
        found = _cross(angular, vectors[..., None])
        return jnp.where(turned[:, None, None, dofs], found, 0.0)

    return Kinematics(
        velocity(kinematics.body_position, tree.moves),
        turning(kinematics.body_rotation, tree.moves),
        turning(kinematics.dof_linear[..., None], axes & ~in_world[:, None])[:, :, 0],
        turning(kinematics.dof_angular[..., None], axes)[:, :, 0],
        velocity(kinematics.dof_anchor, anchors),
    )


def _cross(angular: Float[Array, "n 3"], vectors: Float[Array, "k 3 *m #n"]) -> Float[Array, "k 3 *m n"]:
    """Return w x r for each dof.

    Its entries are chosen, not stacked: what XLA stacks it computes for all bodies.
    """
    (wx, wy, wz), (x, y, z) = angular.T, (vectors[:, i, None] for i in range(3))
    entry = np.arange(3).reshape(3, *[1] * (vectors.ndim - 2))
    return jnp.where(entry == 0, wy * z - wz * y, jnp.where(entry == 1, wz * x - wx * z, wx * y - wy * x))


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
