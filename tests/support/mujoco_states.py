"""MuJoCo C at a robot's configurations, and its velocities."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

import osik_jax as osik


def mujoco_at(robot: osik.Robot, q: Any, model: mujoco.MjModel | None = None) -> mujoco.MjData:
    """Return MuJoCo's poses, motion axes and centres of mass at a configuration, of the robot's model or another."""
    model = robot.mj_model if model is None else model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.mujoco_qpos(jnp.asarray(q))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def full_velocities(robot: osik.Robot) -> np.ndarray:
    """Return the matrix from v to MuJoCo's qvel, from the joints' names alone: followers move with their leaders."""
    model = robot.mj_model
    matrix = np.zeros((model.nv, robot.nv))
    for joint, own_name in zip(map(model.joint, range(model.njnt)), robot.tree.joint_names, strict=True):
        name = joint.name or own_name
        if name not in robot.locked_joints:
            rows = np.arange({0: 6, 1: 3, 2: 1, 3: 1}[int(joint.type[0])])
            _, factor = robot.mimic_joints.get(name, (None, 1.0))
            matrix[joint.dofadr[0] + rows, robot.joint_dof_index(name) + rows] = factor
    return matrix
