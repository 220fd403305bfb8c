"""Poses as NumPy's arrays, and rotations by MuJoCo."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np


class Pose(NamedTuple):
    """Position (3,) [m] and rotation (3, 3) of a frame in another."""

    position: np.ndarray
    rotation: np.ndarray

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.position + self.rotation @ other.position, self.rotation @ other.rotation)


IDENTITY = Pose(np.zeros(3), np.eye(3))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.asarray(rotation, float).ravel())
    return out


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)
