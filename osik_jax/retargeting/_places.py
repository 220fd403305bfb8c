"""World positions of a profile's points along a robot's motion, and distances of its capsules, by MuJoCo's C code."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from ..robot import Robot
from ..robot._mujoco import model_qpos, mujoco_frame_pose
from ._profile import Profile

JOINTS_APART = 3
"""Least number of joints between two capsules that are kept apart."""
_FAR = 0.1
"""Distance up to which MuJoCo computes distances of capsules [m]; only overlaps count."""


class Places(NamedTuple):
    """World positions of a profile's points in each frame."""

    keypoints: dict[str, Float[np.ndarray, "F 3"]]  # positions by role [m]
    # rotation matrices of pelvis, chest (or pelvis again for a rigid trunk), left and right foot
    turns: Float[np.ndarray, "F 4 3 3"]
    # corners of the soles, or lowest points of round feet [m]. (F, 8, 3), or (F, 0, 3) without feet
    soles: Float[np.ndarray, "F corners 3"]
    center: Float[np.ndarray, "F 3"]  # centre of mass [m]
    capsules: Float[np.ndarray, "F k 2 3"]  # both ends of each capsule's axis [m]

    @property
    def standing(self) -> Float[np.ndarray, "F parts 3"]:
        """Return the midpoints of the parts of the feet, in the order of ``Profile.standing`` [m]. (F, 4, 3)."""
        return self.soles.reshape(len(self.soles), self.soles.shape[1] // 2, 2, 3).mean(2)


def find_places(robot: Robot, profile: Profile, qpos: Float[np.ndarray, "F nq"]) -> Places:
    """Return the world positions of a profile's points for some configurations of its MuJoCo model."""
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


class CapsuleDistances:
    """Distances of a profile's capsules, which are free bodies of a MuJoCo model of their own."""

    def __init__(self, profile: Profile) -> None:
        """Build the model."""
        spec = mujoco.MjSpec()
        for c in profile.capsules:
            half = 0.5 * float(np.linalg.norm(np.subtract(c.end, c.start)))
            body = spec.worldbody.add_body(mocap=True)
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE if half > 0.0 else mujoco.mjtGeom.mjGEOM_SPHERE
            body.add_geom(type=kind, size=[c.radius, half, 0.0])
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def of(self, ends: Float[np.ndarray, "k 2 3"], pairs: Sequence[tuple[int, int]]) -> list[float]:
        """Return the distance of each pair [m], negative where they overlap; ``ends`` are those of the axes [m]."""
        self._data.mocap_pos[:] = ends.mean(1)
        for k, along in enumerate(ends[:, 1] - ends[:, 0]):
            mujoco.mju_quatZ2Vec(self._data.mocap_quat[k], along)
        mujoco.mj_kinematics(self._model, self._data)
        return [mujoco.mj_geomDistance(self._model, self._data, *pair, _FAR, None) for pair in pairs]


def pairs_at_home(robot: Robot, profile: Profile) -> list[tuple[int, int]]:
    """Return the pairs of capsules with at least three joints between them that do not overlap at home."""
    if not profile.capsules:
        return []
    bodies = [robot.tree.frame_bodies[robot.tree.frame(c.frame)] for c in profile.capsules]
    pairs = itertools.combinations(range(len(bodies)), 2)
    pairs = [(i, j) for i, j in pairs if joints_between(robot, bodies[i], bodies[j]) >= JOINTS_APART]
    home = find_places(robot, profile, model_qpos(robot, robot.q0)).capsules[0]
    distances = CapsuleDistances(profile).of(home, pairs)
    return [pair for pair, distance in zip(pairs, distances, strict=True) if distance >= 0.0]


def joints_between(robot: Robot, a: int, b: int) -> int:
    """Return the number of joints on the tree path between two bodies."""
    above = robot.tree.descendants
    return int((above[:, a] != above[:, b]).sum())
