"""Detection of the up axis of a clip, from its motion and from the expected axis of its format."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError, warn
from ._motion import HumanMotion
from ._rotations import continuous, moved_poses
from ._skeletons import find_roles

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
UPS: tuple[Up, ...] = get_args(Up)
_NEAR_FLOOR, _LOW_SHARE, _FLOOR_WEIGHT = 0.05, 10.0, 1.5
"""Largest height of the lowest point in a frame that stands on the floor [m], percentile of lowest points that defines
the floor, and weight of the share of such frames relative to how upright the person is.
"""
_STANDS, _LEANS, _ON_FLOOR = 0.7, 0.1, 0.5
_CLEARLY = 0.5
"""Score above the expected axis' at which another axis is taken."""


def find_up(motion: HumanMotion, expected: Up, roles: Mapping[str, str] | None = None) -> Up:
    """Return the up axis of a motion in metres; the expected one if no joint is known as a shoulder or a foot.

    The person stands along the up axis, and the lowest point is near one height in most frames. The expected axis is
    kept if the person stands along it, if the person lies on a floor at height 0 along it (and on none along the other
    axis), or if no other axis is clearly better.
    """
    points = _tracks(motion, roles)
    if points is None:
        return expected
    top, bottom, tracks = points
    upright = _upright(top - bottom)
    lowest = np.concatenate([tracks.min(1), -tracks.max(1)], -1)  # x, y, z, -x, -y, -z
    floor = np.percentile(lowest, _LOW_SHARE, axis=0)
    grounded = (np.abs(lowest - floor) < _NEAR_FLOOR).mean(0)
    score, own = upright + _FLOOR_WEIGHT * grounded, UPS.index(expected)
    best = int(np.argmax(np.where(upright > _LEANS, score, -np.inf)))
    at_floor = np.abs(floor) < _NEAR_FLOOR
    lies = grounded[own] > _ON_FLOOR and at_floor[own] and not at_floor[best]
    stands = upright[own] > _STANDS
    return UPS[best] if score[best] - score[own] > _CLEARLY and not stands and not lies else expected


def find_rest_up(motion: HumanMotion) -> Up | None:
    """Return the axis along which the person stands in the rest pose; None if unknown."""
    if motion.rest_positions is None:
        return None
    points = _tracks(dataclasses.replace(motion, positions=motion.rest_positions[None], rotations=None, contact=None))
    upright = np.zeros(6) if points is None else _upright(points[0] - points[1])
    return UPS[int(np.argmax(upright))] if upright.max() > _STANDS else None


def _upright(along: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "6"]:
    """Return the mean components along each of ``UPS`` of the vector from ankles to shoulders over its length."""
    mean = along.mean(0) / max(float(np.percentile(np.linalg.norm(along, axis=-1), 95)), 1e-9)
    return np.concatenate([mean, -mean])


def _tracks(
    motion: HumanMotion, roles: Mapping[str, str] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return points over time: middle of the shoulders, middle of the ankles, and all points that may touch the floor.

    Shapes (F, 3), (F, 3) and (F, k, 3). Without known joints, the head and the mean of the foot joints are taken; None
    without these.
    """
    try:
        roles = find_roles(motion.joint_names, positions=motion.positions) if roles is None else roles
    except OsikValueError:
        heads, feet = named(motion.joint_names, "head"), named(motion.joint_names, "foot", "ankle", "toe")
        if not heads or not feet:
            return None
        return motion.positions[:, heads[-1]], motion.positions[:, feet].mean(1), motion.positions
    at = {role: motion.track(name) for role, name in roles.items()}
    pairs = [(f"left_{part}", f"right_{part}") for part in ("shoulder", "hip", "ankle")]
    middles = [0.5 * (at[left] + at[right]) for left, right in pairs if {left, right} <= set(at)]
    return (middles[0], middles[-1], np.stack(list(at.values()), 1)) if len(middles) > 1 else None


def named(joint_names: tuple[str, ...], *words: str) -> list[int]:
    """Return the indices of joints whose names contain one of some words."""
    return [i for i, name in enumerate(joint_names) if any(word in name.lower() for word in words)]


def _to_z_up(up: Up) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that turns an axis up; facing z with y up becomes facing x with z up."""
    turn = np.roll(np.eye(3), -1 - "xyz".index(up[-1]), 0)
    return np.diag([1.0, -1.0, -1.0]) @ turn if up[0] == "-" else turn


def checked_up(up: str | None) -> Up | None:
    """Return a given axis, or raise ValueError if there is no such axis."""
    if up is not None and up not in UPS:
        raise OsikValueError(f"up is {up!r}; it is one of {', '.join(UPS)}")
    return up


def standing_up(source: str, motion: HumanMotion, up: Up | None, expected: Up, rest_up: Up | None) -> HumanMotion:
    """Return a clip with z up, by the given axis or else by its motion; warn if that is not the expected axis.

    ``up`` is the given axis, ``expected`` the one that this kind of file has up, ``rest_up`` that of the rest pose if
    it differs from the motion's: the rest pose is then rotated separately, and rotations are relative to it. The
    warning names ``source``.
    """
    own = find_up(motion, expected) if up is None else up
    if up is None and own != expected:
        warn(
            f"{source}: the person stands along {own} and not along {expected}, so {own} is taken to point up; "
            f"up={expected!r} keeps {expected}"
        )
    rest_up = own if rest_up is None else rest_up
    if own == rest_up == "z":
        return motion
    turn, rest_turn = _to_z_up(own), _to_z_up(rest_up)
    rotations, rest = motion.rotations, motion.rest_positions
    if rotations is not None:
        rotations = np.concatenate([rotations[..., :1], rotations[..., 1:] @ turn.T], -1)
        if rest_up != own:
            turns = Rotation.from_quat(rotations.reshape(-1, 4), scalar_first=True)
            turns = turns * Rotation.from_matrix(turn @ rest_turn.T)
            rotations = turns.as_quat(scalar_first=True).reshape(rotations.shape)
        rotations = continuous(rotations)
    return dataclasses.replace(
        motion,
        objects={name: moved_poses(poses, turn[None]) for name, poses in motion.objects.items()},
        positions=motion.positions @ turn.T,
        rotations=rotations,
        rest_positions=None if rest is None else rest @ rest_turn.T,
    )
