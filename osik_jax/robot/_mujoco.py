"""Poses and centre of mass from MuJoCo's C code, independent of this package's kinematics."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ._model import RobotModel
from .loading._mjmodel import element_names


def model_qpos(robot: RobotModel, q: ArrayLike | Array) -> Float[np.ndarray, "T full"]:
    """Return configurations of the MuJoCo model, locked and coupled joints included, from (nq,) or (T, nq)."""
    index, coefficient = robot.tree.qpos_source
    return np.atleast_2d(np.asarray(q))[:, index] * coefficient + np.asarray(robot.qpos_offset)


def mujoco_poses(robot: RobotModel, q: ArrayLike | Array) -> Iterator[mujoco.MjData]:
    """Return MuJoCo's body, site, geom and CoM positions [m] at a configuration (nq,) or along a trajectory (T, nq).

    Yields the same ``MjData`` each time, with new content: copy what has to last.
    """
    data = mujoco.MjData(robot.mj_model)
    for qpos in model_qpos(robot, q):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(robot.mj_model, data)
        mujoco.mj_comPos(robot.mj_model, data)
        yield data


def home_poses(robot: RobotModel) -> mujoco.MjData:
    """Return what ``mujoco_poses`` yields at ``robot.q0``."""
    return next(mujoco_poses(robot, robot.q0))


def own_masses(robot: RobotModel) -> Float[np.ndarray, " bodies"]:
    """Return the mass [kg] of each body of ``mj_model``, 0 where it is fixed to the world or not the robot's."""
    model, bodies = robot.mj_model, model_bodies(robot)
    roots = [model.body_rootid[bodies[top]] for top in robot.tree.tops]
    own = np.isin(model.body_rootid, roots) & (model.body_weldid != 0)
    return np.where(own, model.body_mass, 0.0)


def robot_com(robot: RobotModel, data: mujoco.MjData) -> Float[np.ndarray, "3"]:
    """Return the centre of mass [m] of the robot's moving bodies from MuJoCo, without scene and fixed base."""
    mass = own_masses(robot)
    return mass @ data.xipos / mass.sum()


def model_bodies(robot: RobotModel) -> list[int]:
    """Return MuJoCo's index of each body of ``robot.tree``."""
    names = element_names(robot.mj_model, "body")
    return [names.index(name) for name in robot.tree.body_names]


def mujoco_frame_pose(
    robot: RobotModel, data: mujoco.MjData, name: str
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return position [m] and rotation of a frame by its body's pose, in data of the robot's model or of its world."""
    index = robot.tree.frame(name)
    body = element_names(robot.mj_model, "body").index(robot.tree.body_names[robot.tree.frame_bodies[index]])
    turn = data.xmat[body].reshape(3, 3)
    position = data.xpos[body] + turn @ np.asarray(robot.frame_position[index])
    return position, turn @ np.asarray(robot.frame_rotation[index])
