"""Which axis of a clip points up: what its motion shows, beside what is expected."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError, warn
from ._motion import HumanMotion
from ._rotations import continuous, multiply
from ._skeletons import find_roles

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
UPS: tuple[Up, ...] = get_args(Up)
_TO_Z_UP = {
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "y": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "-y": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
"""Rotations that turn an axis up: facing z with y up becomes facing x with z up."""
_NEAR_FLOOR, _LOW_SHARE, _FLOOR_WEIGHT = 0.05, 10.0, 1.5
"""Height of the lowest point above the floor in a frame that stands on it [m]; the percentile of lowest points that is
the floor; what the share of such frames counts beside how upright the person is."""
_STANDS, _LEANS, _ON_FLOOR = 0.7, 0.1, 0.5
_CLEARLY, _PERHAPS = 0.5, 0.1
"""By how much an axis has to score more than the expected one to be taken, and to leave doubts."""


class Evidence(NamedTuple):
    """What speaks for each of ``UPS``. (6,) each.

    Attributes:
        upright: component along the axis of the vector from the ankles to the shoulders, mean over frames, as a share
            of its length.
        grounded: share of frames in which the lowest point is within 5 cm of the floor.
        floor: height of the floor along the axis [m].
    """

    upright: Float[np.ndarray, "6"]
    grounded: Float[np.ndarray, "6"]
    floor: Float[np.ndarray, "6"]

    @property
    def score(self) -> Float[np.ndarray, "6"]:
        """How well each axis explains the motion."""
        return self.upright + _FLOOR_WEIGHT * self.grounded


def find_up(motion: HumanMotion, expected: Up, roles: Mapping[str, str] | None = None) -> tuple[Up, Up | None]:
    """Return the axis that points up in a motion, and another that may do so; None: that is not in doubt.

    The person stands along it, and the lowest point is near one height in most frames. The expected axis is kept where
    the person stands along it, or lies on a floor at height 0 along it and stands on none along the other axis, and
    where no other axis is clearly better.

    Args:
        motion: with any axis up, in metres.
        expected: the axis that is kept where the motion does not say more.
        roles: of each of a person's joints, what the clip calls it; None: by their names.
    """
    found = find_evidence(motion, roles)
    if found is None:
        return expected, None
    own, score = UPS.index(expected), found.score
    best = int(np.argmax(np.where(found.upright > _LEANS, score, -np.inf)))
    more = score[best] - score[own]
    if best == own or not more > _PERHAPS:
        return expected, None
    stands = found.upright[own] > _STANDS
    at_floor = np.abs(found.floor) < _NEAR_FLOOR
    lies = found.grounded[own] > _ON_FLOOR and at_floor[own] and not at_floor[best]
    if more > _CLEARLY and not stands and not lies:
        return UPS[best], None
    return expected, UPS[best]


def find_rest_up(motion: HumanMotion) -> Up | None:
    """Return the axis along which the person stands in the rest pose; None where that is not known."""
    if motion.rest_positions is None:
        return None
    rest = dataclasses.replace(motion, positions=motion.rest_positions[None], rotations=None, contact=None)
    found = find_evidence(rest, None)
    stands = found is not None and found.upright.max() > _STANDS
    return UPS[int(np.argmax(found.upright))] if found is not None and stands else None


def find_evidence(motion: HumanMotion, roles: Mapping[str, str] | None) -> Evidence | None:
    """Return what a motion shows of its up axis; None where no joint is known as a shoulder or a foot."""
    points = _tracks(motion, roles)
    if points is None:
        return None
    top, bottom, tracks = points
    along = top - bottom
    length = max(float(np.percentile(np.linalg.norm(along, axis=-1), 95)), 1e-9)
    mean = along.mean(0) / length
    lowest = np.stack([tracks.min(1), (-tracks).min(1)], -1).reshape(-1, 6)  # x, -x, y, -y, z, -z
    floor = np.percentile(lowest, _LOW_SHARE, axis=0)
    grounded = (np.abs(lowest - floor) < _NEAR_FLOOR).mean(0)
    order = [0, 2, 4, 1, 3, 5]
    return Evidence(np.concatenate([mean, -mean]), grounded[order], floor[order])


def _tracks(motion: HumanMotion, roles: Mapping[str, str] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the tops and the bottoms of a person (F, 3), and all points that may touch the floor (F, k, 3)."""
    try:
        roles = find_roles(motion.joint_names) if roles is None else roles
    except OsikValueError:
        heads, feet = named(motion.joint_names, "head"), named(motion.joint_names, "foot", "ankle", "toe")
        if not heads or not feet:
            return None
        return motion.positions[:, heads[-1]], motion.positions[:, feet].mean(1), motion.positions
    at = {role: motion.track(name) for role, name in roles.items()}
    top, bottom = (0.5 * (at[f"left_{role}"] + at[f"right_{role}"]) for role in ("shoulder", "ankle"))
    return top, bottom, np.stack(list(at.values()), 1)


def named(joint_names: tuple[str, ...], *words: str) -> list[int]:
    """Return the joints with one of some words in their names."""
    return [i for i, name in enumerate(joint_names) if any(word in name.lower() for word in words)]


def turned_up(motion: HumanMotion, up: Up, rest_up: Up | None = None) -> HumanMotion:
    """Return a motion with an axis turned up.

    Rotations are counted from the rest pose, which is turned upright by itself where it stands along another axis.

    Args:
        motion: with the axis ``up`` up.
        up: the axis.
        rest_up: the axis that points up in the rest pose; None: the same.
    """
    rest_up = up if rest_up is None else rest_up
    turn, rest_turn = np.array(_TO_Z_UP[up], float), np.array(_TO_Z_UP[rest_up], float)
    rotations, rest = motion.rotations, motion.rest_positions
    if rotations is not None:
        rotations = np.concatenate([rotations[..., :1], rotations[..., 1:] @ turn.T], -1)
        if rest_up != up:
            between = Rotation.from_matrix(turn @ rest_turn.T).as_quat(scalar_first=True)
            rotations = multiply(rotations, np.broadcast_to(between, rotations.shape))
        rotations = continuous(rotations)
    return dataclasses.replace(
        motion,
        positions=motion.positions @ turn.T,
        rotations=rotations,
        rest_positions=None if rest is None else rest @ rest_turn.T,
    )


def checked_up(up: str | None) -> Up | None:
    """Return an axis that was given.

    Raises:
        ValueError: no such axis.
    """
    if up is not None and up not in UPS:
        raise OsikValueError(f"up is {up!r}; it is one of {', '.join(UPS)}")
    return up


def standing_up(source: str, motion: HumanMotion, up: Up | None, expected: Up, rest_up: Up | None) -> HumanMotion:
    """Return a clip with z up, by the axis that was given or by what its motion shows, and warn where that is another.

    Args:
        source: the file, for the warning.
        motion: as the file has it.
        up: the axis that was given; None: none.
        expected: the axis that the file is expected to have up.
        rest_up: the axis that points up in the rest pose; None: the same as in the motion.
    """
    own = find_up(motion, expected)[0] if up is None else up
    if up is None and own != expected:
        warn(
            f"{source}: the person stands along {own} and not along {expected}, so {own} is taken to point up; "
            f"up={expected!r} keeps {expected}"
        )
    return motion if own == "z" and rest_up in (None, "z") else turned_up(motion, own, rest_up)
