"""Frames and the centre of mass of a robot beside MuJoCo's own reading of its file."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco_states import mujoco_at

import osik_jax as osik


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def poses(robot: osik.Robot, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Positions and rotations of all frames, and the centre of mass, at each configuration."""
    kinematics = osik.forward_kinematics(robot, q)
    return *kinematics.frame_poses(robot, robot.frame_names), osik.center_of_mass(robot, kinematics)


def random_configurations(robot: osik.Robot, seed: int = 3, count: int = 4) -> np.ndarray:
    """Any positions, unit quaternions. (count, nq)"""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (count, robot.nq))
    free, ball = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
    for joint, start in robot.tree.qpos_address.items():
        if (kind := robot.tree.joint_types[joint]) in (free, ball):
            turns = rng.normal(size=(count, 4))
            start += 3 * (kind == free)
            q[:, start : start + 4] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return q


def assert_as_in_mujoco(robot: osik.Robot, model: mujoco.MjModel) -> None:
    """Every named body, site and geom of the model is a frame, at the same place; so is the robot's centre of mass."""
    q = random_configurations(robot)
    tops = {model.body(robot.tree.body_names[top]).id for top in robot.tree.tops}
    own = np.zeros(model.nbody, bool)
    for body in range(1, model.nbody):
        own[body] = body in tops or own[model.body_parentid[body]]
    masses = np.where(own, model.body_mass, 0.0)
    kinds = [(kind, k) for kind in ("body", "site", "geom") for k in range(getattr(model, f"n{kind}"))]
    named = [(kind, name) for kind, k in kinds if (name := getattr(model, kind)(k).name)]
    named = [(kind, name) for kind, name in named if not name.startswith("equality_end/")]  # of what we wrote
    for row, position, rotation, com in zip(q, *map(np.asarray, poses(robot, jnp.asarray(q))), strict=True):
        data = mujoco_at(robot, row, model)
        np.testing.assert_allclose(com, masses @ data.xipos / masses.sum(), rtol=0.0, atol=1e-12)
        for kind, name in named:
            prefixed = f"{kind}:{name}"
            frame = robot.tree.frame(prefixed if prefixed in robot.frame_names else name)
            element = getattr(data, kind)(name)
            np.testing.assert_allclose(position[frame], element.xpos, rtol=0.0, atol=1e-12, err_msg=name)
            np.testing.assert_allclose(rotation[frame].ravel(), element.xmat, rtol=0.0, atol=1e-12, err_msg=name)
