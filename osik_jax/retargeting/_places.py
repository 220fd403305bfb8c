"""World positions of a profile's points along a robot's motion, by MuJoCo's C code."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from ..robot import Robot
from ..robot._mujoco import mujoco_frame_pose
from ._profile import Profile


class Places(NamedTuple):
    """World positions of a profile's points in each frame.

    Attributes:
        keypoints: positions by role [m]. (F, 3) each
        turns: rotation matrices of pelvis, chest (or pelvis again for a rigid trunk), left and right foot. (F, 4, 3, 3)
        soles: corners of the soles, or lowest points of round feet [m]. (F, 8, 3), or (F, 0, 3) without feet
        center: centre of mass [m]. (F, 3)
        capsules: both ends of each capsule's axis [m]. (F, k, 2, 3)
    """

    keypoints: dict[str, Float[np.ndarray, "F 3"]]
    turns: Float[np.ndarray, "F 4 3 3"]
    soles: Float[np.ndarray, "F corners 3"]
    center: Float[np.ndarray, "F 3"]
    capsules: Float[np.ndarray, "F k 2 3"]

    @property
    def standing(self) -> Float[np.ndarray, "F parts 3"]:
        """Return the midpoints of the parts of the feet, in the order of ``Profile.standing`` [m]. (F, 4, 3)."""
        return self.soles.reshape(len(self.soles), self.soles.shape[1] // 2, 2, 3).mean(2)


def find_places(robot: Robot, profile: Profile, qpos: Float[np.ndarray, "F nq"]) -> Places:
    """Return the world positions of a profile's points for some configurations.

    Args:
        robot: the robot.
        profile: its profile.
        qpos: configurations of its MuJoCo model. (F, nq)
    """
    data = mujoco.MjData(robot.mj_model)
    wanted = [*profile.keypoints.values(), *profile.corners]
    wanted += [(c.frame, point) for c in profile.capsules for point in (c.start, c.end)]
    turned = profile.turned
    points, center = np.zeros((len(qpos), len(wanted), 3)), np.zeros((len(qpos), 3))
    turns = np.zeros((len(qpos), len(turned), 3, 3))
    root = robot.mj_model.body(robot.tree.body_names[robot.tree.root]).id
    frames = tuple(dict.fromkeys([*turned, *(frame for frame, _ in wanted)]))
    for f, own in enumerate(qpos):
        data.qpos[:] = own
        mujoco.mj_kinematics(robot.mj_model, data)
        poses = {frame: mujoco_frame_pose(robot, data, frame) for frame in frames}
        mujoco.mj_comPos(robot.mj_model, data)
        center[f] = data.subtree_com[root]
        points[f] = [poses[frame][0] + poses[frame][1] @ np.array(point) for frame, point in wanted]
        turns[f] = [poses[frame][1] for frame in turned]
    keys, corners = len(profile.keypoints), len(profile.corners)
    points[:, keys : keys + corners, 2] -= profile.rises
    return Places(
        keypoints=dict(zip(profile.keypoints, np.moveaxis(points[:, :keys], 1, 0), strict=True)),
        turns=turns,
        soles=points[:, keys : keys + corners],
        center=center,
        capsules=points[:, keys + corners :].reshape(len(points), -1, 2, 3),
    )
