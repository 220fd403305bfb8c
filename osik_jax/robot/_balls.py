"""Ranges of ball joints: their rotation angles, and configurations inside the ranges."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from ..numerics._host import Numbers, module_of
from ._tree import BALL, KinematicTree


def independent_balls(tree: KinematicTree) -> list[int]:
    """Return ball joints that own entries of q and v."""
    return [joint for joint in tree.independent if tree.joint_types[joint] == BALL]


def ball_rotation(quaternion: Float[Numbers, "4"]) -> tuple[Float[Numbers, ""], Float[Numbers, "3"]]:
    """Return the angle [rad], from 0 to pi, and the axis of the rotation of a quaternion w x y z.

    The axis of no rotation is zero. The axis is the same in the joint's body and in the body before it, and along it
    the angle grows at the rate of the angular velocity.
    """
    xp = module_of(quaternion)
    part = quaternion[1:] * xp.where(quaternion[0] < 0.0, -1.0, 1.0)
    squared = (part**2).sum()
    still = squared <= jnp.finfo(quaternion.dtype).tiny
    length = xp.sqrt(xp.where(still, 1.0, squared))
    angle = xp.where(still, 0.0, 2.0 * xp.arctan2(length, abs(quaternion[0])))
    return angle, xp.where(still, 0.0, part / length)


def with_balls_inside(
    tree: KinematicTree, q: Float[Numbers, " nq"], upper: Float[Numbers, " nv"]
) -> Float[Numbers, " nq"]:
    """Return the configuration with ball joints turned back along their axis to the end of their range.

    ``upper`` has the greatest angle [rad] in the three entries of each ball joint; inf where free.
    """
    xp = module_of(q)
    for joint in independent_balls(tree):
        at, greatest = tree.qpos_address[joint], upper[tree.dof_address[joint]]
        angle, axis = ball_rotation(q[at : at + 4])
        half = 0.5 * xp.where(xp.isinf(greatest), 0.0, greatest)
        end = xp.concatenate([xp.cos(half)[None], xp.sin(half) * axis])
        q = xp.concatenate([q[:at], xp.where(angle > greatest, end, q[at : at + 4]), q[at + 4 :]])
    return q
