"""Ranges of ball joints: their rotation angles, and configurations inside the ranges."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._tree import BALL, KinematicTree


def independent_balls(tree: KinematicTree) -> list[int]:
    """Return ball joints that own entries of q and v."""
    return [joint for joint in tree.independent if tree.joint_types[joint] == BALL]


def ball_rotation(quaternion: Float[Array, "4"]) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Return the angle [rad], from 0 to pi, and the axis of the rotation of a quaternion w x y z.

    The axis of no rotation is zero. The axis is the same in the joint's body and in the body before it, and along it
    the angle grows at the rate of the angular velocity.
    """
    part = quaternion[1:] * jnp.where(quaternion[0] < 0.0, -1.0, 1.0)
    squared = jnp.sum(part**2)
    still = squared <= jnp.finfo(quaternion.dtype).tiny
    length = jnp.sqrt(jnp.where(still, 1.0, squared))
    angle = jnp.where(still, 0.0, 2.0 * jnp.arctan2(length, jnp.abs(quaternion[0])))
    return angle, jnp.where(still, 0.0, part / length)


def with_balls_inside(tree: KinematicTree, q: Float[Array, " nq"], upper: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Return the configuration with ball joints turned back along their axis to the end of their range.

    Args:
        tree: the robot's tree.
        q: configuration. (nq,)
        upper: the greatest angle [rad], in the three entries of each ball joint; inf where free. (nv,)
    """
    for joint in independent_balls(tree):
        at, greatest = tree.qpos_address[joint], upper[tree.dof_address[joint]]
        angle, axis = ball_rotation(q[at : at + 4])
        half = 0.5 * jnp.where(jnp.isinf(greatest), 0.0, greatest)
        end = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])
        q = q.at[at : at + 4].set(jnp.where(angle > greatest, end, q[at : at + 4]))
    return q
