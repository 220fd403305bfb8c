"""Joint transforms from MuJoCo, relative to the parent bodies, so that XLA does not recompute chains of parents.

On a serial chain, XLA's CPU fusion of ``mjx.kinematics`` recomputes all ancestors of each link. So MuJoCo gets a forest
in which each body's parent is the world, and returns poses relative to the parents; ``_composition`` composes the tree.
In a program it is MJX; on the host, with NumPy's arrays, MuJoCo's C, which compiles nothing.
"""

from __future__ import annotations

import contextlib
from functools import cache, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ..numerics._host import Numbers
from ..robot import Robot
from ..robot._tree import KinematicTree
from ._rigid import rotation_matrix


class JointTransforms(NamedTuple):
    """Poses and joints of all bodies, each in the frame of the body's parent."""

    position: Float[Numbers, "nbody 3"]  # origin of each body [m]; row 0 is the world, 0
    rotation: Float[Numbers, "nbody 3 3"]  # from each body's axes to its parent's; row 0 is the identity
    anchor: Float[Numbers, "njoint 3"]  # a point on each joint's axis [m]
    # of each joint, as long as its quaternion and axis in the model are; none for free joints
    axis: Float[Numbers, "njoint 3"]


def joint_transforms(robot: Robot, qpos: Float[Numbers, " nqfull"]) -> JointTransforms:
    """Return poses and joints relative to the parents at a full configuration; its quaternions are normalised."""
    return _on_host(robot, qpos) if isinstance(qpos, np.ndarray) else _in_program(robot, qpos)


def _on_host(robot: Robot, qpos: Float[np.ndarray, " nqfull"]) -> JointTransforms:
    model = _forest(robot.tree.joint_types, robot.tree.joint_bodies, len(robot.tree.body_names)).__copy__()
    for name, numbers in _numbers(robot, np).items():
        getattr(model, name)[:] = numbers
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return JointTransforms(data.xpos, data.xmat.reshape(-1, 3, 3), data.xanchor, data.xaxis)


def _in_program(robot: Robot, qpos: Float[Array, " nqfull"]) -> JointTransforms:
    tree = robot.tree
    model, data = _in_mjx(tree.joint_types, tree.joint_bodies, len(tree.body_names), jnp.result_type(float).name)
    found = _mjx().kinematics(model.replace(**_numbers(robot, jnp)), data.replace(qpos=qpos))
    return JointTransforms(found.xpos, rotation_matrix(found.xquat), found.xanchor, found.xaxis)


def _numbers(robot: Robot, xp: Any) -> dict[str, Any]:
    """Return the robot's numbers under their names in MuJoCo's model; the world's row is the identity."""
    moves = np.arange(len(robot.tree.body_names))[:, None] > 0
    return {
        "body_pos": xp.where(moves, robot.body_position, 0.0),
        "body_quat": xp.where(moves, robot.body_quaternion, np.eye(1, 4, dtype=robot.body_quaternion.dtype)),
        "jnt_pos": robot.joint_position,
        "jnt_axis": robot.joint_axis,
        "qpos0": robot.joint_reference,
    }


@cache
def _mjx() -> Any:
    with contextlib.redirect_stdout(None):  # it prints which of its optional back ends are missing
        from mujoco import mjx  # takes half a second, and no call of the core needs it

    return mjx


@lru_cache(maxsize=64)
def _forest(joint_types: tuple[int, ...], joint_bodies: tuple[int, ...], bodies: int) -> mujoco.MjModel:
    """Return a model with these joints on bodies of the world; its numbers are placeholders."""
    spec = mujoco.MjSpec()
    for body in range(1, bodies):
        element = spec.worldbody.add_body(mass=1.0, inertia=np.ones(3), explicitinertial=True)
        for joint, owner in enumerate(joint_bodies):
            if owner == body:
                element.add_joint(type=mujoco.mjtJoint(joint_types[joint]), armature=1.0)  # or MuJoCo warns
    return spec.compile()


@lru_cache(maxsize=64)
def _in_mjx(
    joint_types: tuple[int, ...], joint_bodies: tuple[int, ...], bodies: int, precision: str
) -> tuple[Any, Any]:
    """Return the forest as a model of MJX, and its data."""
    del precision  # part of the cache key: the arrays take the precision in force when they are made
    here = jax.local_devices()[0]  # MJX would take the first device of all hosts
    with jax.ensure_compile_time_eval():
        model = _mjx().put_model(_forest(joint_types, joint_bodies, bodies), device=here, impl="jax")
        return model, _mjx().make_data(model, device=here, impl="jax")


def dof_kinds(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint type of each dof (locked ones included), and the dof's index within its joint."""
    kinds = np.asarray(tree.joint_types, int)[tree.dof_joint]
    return kinds, np.arange(len(kinds)) - tree.full_dof_address[:-1][tree.dof_joint]
