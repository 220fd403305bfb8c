"""Poses and centre of mass from MuJoCo's C code, independent of this package's kinematics."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..robot import Robot
from ..robot._own_masses import own_masses


def mujoco_poses(robot: Robot, q: ArrayLike | Array) -> Iterator[mujoco.MjData]:
    """Return MuJoCo's body, site, geom and CoM positions [m] at a configuration (nq,) or along a trajectory (T, nq).

    Yields the same ``MjData`` each time, with new content: copy what has to last.
    """
    index, coefficient = robot.tree.qpos_source
    data = mujoco.MjData(robot.mj_model)
    for qpos in np.atleast_2d(np.asarray(q))[:, index] * coefficient + np.asarray(robot.qpos_offset):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(robot.mj_model, data)
        mujoco.mj_comPos(robot.mj_model, data)
        yield data


def robot_com(robot: Robot, data: mujoco.MjData) -> Float[np.ndarray, "3"]:
    """Return the centre of mass [m] of the robot's moving bodies from MuJoCo, without scene and fixed base."""
    mass = own_masses(robot)
    return mass @ data.xipos / mass.sum()


def model_bodies(robot: Robot) -> list[int]:
    """Return MuJoCo's index of each body of ``robot.tree``."""
    model = robot.mj_model
    names = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, b) or f"body{b}": b for b in range(model.nbody)}
    return [names[name] for name in robot.tree.body_names]


def mujoco_frame_pose(
    robot: Robot, data: mujoco.MjData, name: str
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return position [m] and rotation of a frame: MuJoCo's site or body of that name, else from its body's pose.

    Raises:
        KeyError: no such frame.
    """
    index, model = robot.tree.frame(name), robot.mj_model
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
    if site >= 0:
        return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()
    body = model_bodies(robot)[robot.tree.frame_bodies[index]]
    turn = data.xmat[body].reshape(3, 3)
    position = data.xpos[body] + turn @ np.asarray(robot.frame_position[index])
    return position, turn @ np.asarray(robot.frame_rotation[index])
