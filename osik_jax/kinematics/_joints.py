"""Joint transforms from MJX, relative to the parent bodies, so that XLA does not recompute chains of parents.

On a serial chain, XLA's CPU fusion of ``mjx.kinematics`` recomputes all ancestors of each link. So MJX gets a forest in
which each body's parent is the world, and returns poses relative to the parents; ``_composition`` composes the tree.
"""

from __future__ import annotations

import contextlib
from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ..robot import Robot
from ..robot._tree import KinematicTree

with contextlib.redirect_stdout(None):  # it prints which of its optional back ends are missing
    from mujoco import mjx


def joint_transforms(robot: Robot, qpos: Float[Array, " nqfull"]) -> mjx.Data:
    """Return MJX data in which ``xpos, xquat, xanchor, xaxis`` are in the frame of each body's parent.

    Quaternions have the length of the model's quaternions and axes: 1, unless these numbers were changed. The world's
    row is the identity.
    """
    model, data = _forest(
        robot.tree.joint_types, robot.tree.joint_bodies, len(robot.tree.body_names), jnp.result_type(float).name
    )
    moves = np.arange(len(robot.tree.body_names))[:, None] > 0
    model = model.replace(
        body_pos=jnp.where(moves, robot.body_position, 0.0),
        body_quat=jnp.where(moves, robot.body_quaternion, np.eye(1, 4, dtype=robot.body_quaternion.dtype)),
        jnt_pos=robot.joint_position,
        jnt_axis=robot.joint_axis,
        qpos0=robot.joint_reference,
    )
    return mjx.kinematics(model, data.replace(qpos=qpos))


@lru_cache(maxsize=64)
def _forest(
    joint_types: tuple[int, ...], joint_bodies: tuple[int, ...], bodies: int, precision: str
) -> tuple[mjx.Model, mjx.Data]:
    """Return an MJX model with these joints on bodies of the world, and its data; its numbers are placeholders."""
    del precision  # part of the cache key: the arrays take the precision in force when they are made
    spec = mujoco.MjSpec()
    for body in range(1, bodies):
        element = spec.worldbody.add_body(mass=1.0, inertia=np.ones(3), explicitinertial=True)
        for joint, owner in enumerate(joint_bodies):
            if owner == body:
                element.add_joint(type=mujoco.mjtJoint(joint_types[joint]), armature=1.0)  # or MuJoCo warns
    here = jax.local_devices()[0]  # MJX would take the first device of all hosts
    with jax.ensure_compile_time_eval():
        model = mjx.put_model(spec.compile(), device=here, impl="jax")
        return model, mjx.make_data(model, device=here, impl="jax")


def dof_kinds(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint type of each dof (locked ones included), and the dof's index within its joint."""
    kinds = np.asarray(tree.joint_types, int)[tree.dof_joint]
    return kinds, np.arange(len(kinds)) - tree.full_dof_address[:-1][tree.dof_joint]
