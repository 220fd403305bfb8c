"""Smooth paths of frames through poses, in pieces between corners."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from .._errors import OsikValueError, unknown_name
from ..inverse._poses import read_poses as read_targets
from ..robot import Robot

_CORNER = np.deg2rad(30.0)
"""A path that turns by more than this at a pose has a corner there: the motion stops at it."""
_METRES_PER_RADIAN = 0.1


class Poses(NamedTuple):
    """Poses of one frame; rotations are None where any orientation will do."""

    position: Float[np.ndarray, "N 3"]
    rotation: Float[np.ndarray, "N 3 3"] | None

    def part(self, which: slice) -> Poses:
        """Return some of the poses."""
        return Poses(self.position[which], None if self.rotation is None else self.rotation[which])


def read_poses(robot: Robot, given: Mapping[str, Any]) -> dict[str, Poses]:
    """Return the poses of all frames as positions and rotation matrices.

    Raises:
        KeyError: no such frame.
        ValueError: no poses, numbers that are no poses, or other numbers of poses for other frames.
    """
    if not isinstance(given, Mapping) or not given:
        raise OsikValueError('poses are a mapping from frames, such as {"tool": (positions, quaternions)}')
    for name in given:
        if name not in robot.tree.frame_names:
            raise unknown_name("frame", name, robot.tree.frame_names)
    goal, rows, count = read_targets(robot, given)
    if count is None or count < 2:
        raise OsikValueError("there is one pose; a path has two or more. inverse_kinematics answers a single one")
    position, rotation = (np.asarray(part, float) for part in goal)
    parts = zip(given, rows, position.swapaxes(0, 1), rotation.swapaxes(0, 1), strict=True)
    return {name: Poses(place, turn if all(own) else None) for name, own, place, turn in parts}


def lengths(poses: Mapping[str, Poses]) -> Float[np.ndarray, " N"]:
    """Return the length of the path up to each pose; a radian counts as 0.1 m.

    Raises:
        ValueError: two poses in a row are equal.
    """
    steps = np.zeros(len(next(iter(poses.values())).position) - 1)
    for one in poses.values():
        steps += np.linalg.norm(np.diff(one.position, axis=0), axis=1)
        if one.rotation is not None:
            turn = Rotation.from_matrix(one.rotation)
            steps += _METRES_PER_RADIAN * (turn[:-1].inv() * turn[1:]).magnitude()
    if (steps < 1e-9).any():
        first = int((steps < 1e-9).argmax())
        raise OsikValueError(f"poses {first} and {first + 1} are equal; a path has none twice in a row: remove one")
    return np.append(0.0, np.cumsum(steps))


def corners(poses: Mapping[str, Poses]) -> list[int]:
    """Return the numbers of the poses where pieces of the path begin and end."""
    turn = np.zeros(len(next(iter(poses.values())).position) - 2)
    for one in poses.values():
        step = np.diff(one.position, axis=0)
        size = np.linalg.norm(step, axis=1)
        cosine = (step[1:] * step[:-1]).sum(axis=1) / np.maximum(size[1:] * size[:-1], 1e-18)
        moves = np.minimum(size[1:], size[:-1]) > 1e-9
        turn = np.maximum(turn, np.where(moves, np.arccos(np.clip(cosine, -1.0, 1.0)), 0.0))
    return [0, *(np.flatnonzero(turn > _CORNER) + 1).tolist(), len(turn) + 1]


def interpolated(poses: Mapping[str, Poses], along: np.ndarray, count: int) -> dict[str, Poses]:
    """Return poses at the ends of ``count`` equal parts between each two corners, on smooth curves."""
    ends = corners(poses)
    found: dict[str, list[Poses]] = {name: [] for name in poses}
    for first, last in itertools.pairwise(ends):
        part = slice(first, last + 1)
        places = np.linspace(along[first], along[last], count + 1)[1 if first else 0 :]
        for name, one in poses.items():
            found[name].append(_curve(one.part(part), along[part], places))
    return {name: _joined(parts) for name, parts in found.items()}


def _curve(poses: Poses, along: np.ndarray, places: np.ndarray) -> Poses:
    position = CubicSpline(along, poses.position)(places)
    if poses.rotation is None:
        return Poses(position, None)
    return Poses(position, RotationSpline(along, Rotation.from_matrix(poses.rotation))(places).as_matrix())


def _joined(parts: list[Poses]) -> Poses:
    rotations = [one.rotation for one in parts if one.rotation is not None]
    return Poses(np.concatenate([one.position for one in parts]), np.concatenate(rotations) if rotations else None)
