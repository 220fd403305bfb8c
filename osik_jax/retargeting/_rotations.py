"""Rotations of recorded motion in NumPy: quaternions w x y z with any leading shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
"""Quaternion of no rotation."""


def forward(
    parents: Sequence[int], offsets: Float[np.ndarray, "*F J 3"], local: Float[np.ndarray, "F J 4"]
) -> tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F J 4"]]:
    """Return the positions and rotations of a tree's joints in the world from those relative to their parents.

    Each joint's parent comes before it, -1 for the root. Offsets are positions in the parent's frame, in any unit.
    """
    positions = np.array(np.broadcast_to(offsets, (*local.shape[:2], 3)))
    turns = [Rotation.from_quat(local[:, joint], scalar_first=True) for joint in range(len(parents))]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            positions[:, joint] = positions[:, parent] + turns[parent].apply(positions[:, joint])
            turns[joint] = turns[parent] * turns[joint]
    return positions, np.stack([turn.as_quat(scalar_first=True) for turn in turns], 1)


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """Return the same rotations with the quaternion sign nearest to the frame before. (F, ..., 4)."""
    if len(quaternion) < 2:
        return quaternion
    turned = np.sum(quaternion[1:] * quaternion[:-1], -1) < 0.0
    sign = np.cumprod(np.where(turned, -1.0, 1.0), 0)
    return np.concatenate([quaternion[:1], quaternion[1:] * sign[..., None]])


def slerp(a: np.ndarray, b: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the spherical interpolation from a to b along the shorter arc, at a fraction in [0, 1]. (..., 4)."""
    first, last = (Rotation.from_quat(q.reshape(-1, 4), scalar_first=True) for q in (a, b))
    moved = Rotation.from_rotvec(np.reshape(part, (-1, 1)) * (first.inv() * last).as_rotvec())
    return (first * moved).as_quat(scalar_first=True).reshape(a.shape)


def moved_poses(
    poses: Float[np.ndarray, "F 7"], turn: Float[np.ndarray, "_ 3 3"], by: Float[np.ndarray, "F 3"] | float = 0.0
) -> Float[np.ndarray, "F 7"]:
    """Return poses that are turned about the origin and moved [m]. (F, 7)."""
    turned = Rotation.from_matrix(turn) * Rotation.from_quat(poses[:, 3:], scalar_first=True)
    at = (turn @ poses[:, :3, None])[..., 0] + by
    return np.concatenate([at, turned.as_quat(scalar_first=True)], -1)
