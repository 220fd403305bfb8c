"""Reader of BVH files: a tree of joints with offsets and channels, then one row of numbers per frame.

A BVH file states neither unit nor up axis. The caller gives them, or they are inferred from the rest pose.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._errors import OsikKeyError, OsikValueError, warn
from ..numerics._columns import as_number
from ._motion import HumanMotion
from ._rotations import UNTURNED, continuous, forward
from ._up import UPS, Up, checked_up, find_up, named, standing_up

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Length of one file unit [m]; ``cmu`` is the unit of the CMU database's skeletons."""
# Size of a rest pose that is believed to be a person's [m]: an unknown unit is the first that gives such a size.
_HEIGHTS = (1.0, 2.3)
_SLOWEST, _FASTEST = 1.0, 1e-5
"""Longest and shortest accepted frame time [s]."""
_UPRIGHT = 0.6
"""Least height of the head above the feet in an upright rest pose, as a share of the path length along the joints."""
_LIKE = np.radians(30.0)
"""Largest rotation of a joint relative to the root in a frame taken for the rest pose [rad]; legs in CMU files have 21
degrees in their first frame.
"""
_JUMP = 5.0
"""Speed of a joint relative to the root above which the step out of the rest pose counts as a jump [m/s]."""
_ABOVE_ALL = 3.0
"""Least ratio of that step to every other step of the clip."""
_CHANNELS = {f"{axis}{kind}".lower(): (kind, axis) for axis in "XYZ" for kind in ("position", "rotation")}
_LARGEST = 1e8
"""Largest accepted absolute value of a length in any unit, or of an angle [deg]."""


@dataclasses.dataclass
class _Joint:
    """One joint of a BVH tree, in the file's axes and unit."""

    name: str
    parent: int
    offset: Float[np.ndarray, "3"]
    channels: tuple[tuple[str, str], ...]
    is_end: bool


def read_bvh(path: str | os.PathLike[str], *, unit: str | float | None = None, up: Up | None = None) -> HumanMotion:
    """Read a BVH file.

    A joint's rotation is the product of its channels in the order in which the file lists them. Ends of chains
    (``End Site``) become joints called ``PARENT_end`` unless their offset is 0. ``rest_positions`` is the pose with all
    rotations 0 and the root at the origin; None if nobody stands in it, as in files with all bones along one axis.
    Facing z with y up becomes facing x with z up.

    ``unit``, ``up`` and errors are those of ``load_motion``. If nobody stands in the rest pose, the
    length of the joints from a foot to the head gives the unit.
    """
    source, up = str(path), checked_up(up)
    words, joints = _Words(source, Path(path).read_text(encoding="utf-8-sig", errors="replace")), list[_Joint]()
    words.take("HIERARCHY")
    words.take("ROOT")
    try:
        _read_joint(words, joints, -1)
    except RecursionError:
        raise words.error("joints are inside each other without end") from None
    fps, values = _frames(words, sum(len(joint.channels) for joint in joints))
    parents, names = [joint.parent for joint in joints], tuple(joint.name for joint in joints)
    if len(set(names)) < len(names):
        raise OsikValueError(f"{source}: a second joint is called {max(names, key=names.count)}")
    positions, rotations = forward(parents, *_moves(joints, values))
    rest = forward(parents, np.array([joint.offset for joint in joints]), np.tile(UNTURNED, (1, len(joints), 1)))[0][0]
    rest = rest - rest[0]
    heads, feet = named(names, "head"), named(names, "foot", "ankle", "toe")
    way = _way(joints, heads[-1], feet[-1]) if heads and feet else 0.0
    rest_up = _axis_up(rest[heads[-1]] - rest[feet].mean(0), way) if way else None
    stands = rest_up is not None or not way
    scale = _scale(source, unit, float(np.ptp(rest, axis=0).max()) if stands else way)
    kept = [i for i, joint in enumerate(joints) if not joint.is_end or joint.offset.any()]
    motion = HumanMotion(
        name=Path(path).stem,
        fps=fps,
        joint_names=tuple(names[i] for i in kept),
        positions=scale * positions[:, kept],
        rotations=continuous(rotations[:, kept]),
        rest_positions=scale * rest[kept] if stands else None,
    )
    motion = standing_up(source, motion, up, rest_up or find_up(motion, "y"), rest_up)
    count = _rest_frames(motion)
    if not count:
        return motion
    warn(f"{source} begins with its rest pose ({count} of {motion.frames} frames), left out")
    turns = motion.rotations
    return dataclasses.replace(
        motion, positions=motion.positions[count:], rotations=None if turns is None else continuous(turns[count:])
    )


def _rest_frames(motion: HumanMotion) -> int:
    """Return the number of rest-pose frames put before a clip's motion; 0 unless that is certain.

    In these frames all joints are rotated as the root within 30 degrees. The step to the next frame moves a joint
    relative to the root at over 5 m/s, and three times farther than any other step of the clip. So a person who starts
    from the rest pose loses no frame. 0 if rotations or the rest pose are unknown.
    """
    turns = motion.rotations
    if turns is None or motion.rest_positions is None or motion.frames < 3:
        return 0
    beside = motion.positions - motion.positions[:, :1]
    steps = np.linalg.norm(np.diff(beside, axis=0), axis=-1).max(1)
    count = int(np.argmax(steps)) + 1
    others = np.delete(steps, count - 1)
    jumps = steps[count - 1] * motion.fps > _JUMP and steps[count - 1] > _ABOVE_ALL * others.max()
    alike = np.abs(np.sum(turns * turns[:, :1], -1)).min(1) > np.cos(0.5 * _LIKE)
    return count if jumps and motion.frames - count > 1 and alike[:count].all() and not alike[count] else 0


def _read_joint(words: _Words, joints: list[_Joint], parent: int, is_end: bool = False) -> None:
    """Read a joint after the word ROOT, JOINT or End, and all joints inside its braces; parents come first."""
    name = words.name()
    words.take("{")
    words.take("OFFSET")
    offset, channels = words.numbers(3), ()
    if not is_end and words.next("CHANNELS, JOINT, End Site or }") == "CHANNELS":
        channels = _read_channels(words)
    elif not is_end:
        words.at -= 1
    if is_end:
        name = f"{joints[parent].name}_end"
        name = name if all(joint.name != name for joint in joints) else f"{name}_{len(joints)}"
    own = len(joints)
    joints.append(_Joint(name, parent, offset, channels, is_end))
    expected = "}" if is_end else "JOINT, End Site or }"
    while (kind := words.next(expected)) != "}":
        if is_end or kind not in ("JOINT", "END"):
            raise words.error(f"{expected} should come here")
        _read_joint(words, joints, own, kind == "END")


def _read_channels(words: _Words) -> tuple[tuple[str, str], ...]:
    """Return kind and axis of each channel after the word CHANNELS."""
    count = words.next("the number of channels")
    is_count = count.isdecimal()
    names = [words.next("a channel").lower() for _ in range(int(count) if is_count else 0)]
    unknown = [name for name in names if name not in _CHANNELS]
    if unknown or not is_count or len(set(names)) < len(names):
        raise words.error(f"CHANNELS is followed by how many there are, and by some of {', '.join(_CHANNELS)}")
    return tuple(_CHANNELS[name] for name in names)


def _frames(words: _Words, channels: int) -> tuple[float, Float[np.ndarray, "F C"]]:
    """Return the frame rate [1/s] and one row of numbers per frame."""
    words.take("MOTION")
    if not channels:
        raise words.error("no joint has CHANNELS")
    words.take("FRAMES:")
    count = words.next("the number of frames")
    words.take("FRAME")
    words.take("TIME:")
    step = as_number(words.next("the frame time"))
    if not _FASTEST <= step <= _SLOWEST:
        raise words.error(f"the frame time is {step:g}; it is in seconds, {_FASTEST:g} to {_SLOWEST:g}")
    values = words.rows(channels)
    if count != str(len(values)) or not len(values):
        raise words.error(f"the file says Frames: {count}, and has {len(values)}")
    fps = 1.0 / step
    # files round the frame time (0.0333333 s), so a rate within 0.01 of an integer is that integer
    return (float(round(fps)) if abs(fps - round(fps)) < 1e-2 else fps), values


def _moves(joints: list[_Joint], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (F, J, 3) and rotations (F, J, 4; w x y z) relative to the parents, in the file's unit.

    A position channel replaces the OFFSET along its axis.
    """
    column, offsets = 0, np.tile([joint.offset for joint in joints], (len(values), 1, 1))
    local = np.tile(UNTURNED, (*offsets.shape[:2], 1))
    for i, joint in enumerate(joints):
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        turns = [k for k, (kind, _) in enumerate(joint.channels) if kind == "rotation"]
        for k, (kind, axis) in enumerate(joint.channels):
            if kind == "position":
                offsets[:, i, "XYZ".index(axis)] = own[:, k]
        if turns:  # capital letters: about the axes that the earlier channels have turned
            order = "".join(joint.channels[k][1] for k in turns)
            local[:, i] = Rotation.from_euler(order, own[:, turns], degrees=True).as_quat(scalar_first=True)
    return offsets, local


def _axis_up(feet_to_head: Float[np.ndarray, "3"], way: float) -> Up | None:
    """Return the up axis of the rest pose, or None if nobody stands in it.

    The person stands if the head is above the feet by at least 0.6 of the path length between them. ``way`` is the path
    length along the joints from foot to head.
    """
    above = np.concatenate([feet_to_head, -feet_to_head])
    return UPS[int(np.argmax(above))] if above.max() > _UPRIGHT * way else None


def _way(joints: list[_Joint], a: int, b: int) -> float:
    """Return the length of the path along the joints from joint a to joint b, in file units."""

    def to_root(joint: int) -> list[int]:
        return [] if joint < 0 else [joint, *to_root(joints[joint].parent)]

    return float(sum(np.linalg.norm(joints[i].offset) for i in {*to_root(a)} ^ {*to_root(b)}))


def _scale(path: str, unit: str | float | None, size: float) -> float:
    """Return the length of one file unit [m], as given or inferred from the size of the rest pose [file units]."""
    if isinstance(unit, str):
        if unit not in UNITS:
            raise OsikKeyError(f"no unit {unit!r}; units: {', '.join(UNITS)}, or metres a unit as a number")
        return UNITS[unit]
    if unit is not None:
        if not (np.isfinite(unit) and unit > 0.0):
            raise OsikValueError(f"unit is {unit}; it is metres a unit, more than 0")
        return float(unit)
    for factor in UNITS.values():
        if _HEIGHTS[0] <= factor * size <= _HEIGHTS[1]:
            return factor
    raise OsikValueError(
        f"{path}: the rest pose is {size:.4g} units large, which is no person's size in any of {', '.join(UNITS)}: say "
        "what a unit is with unit=METRES"
    )


class _Words:
    """Words of a BVH file, read one after the other wherever its lines end; errors name the line read last."""

    def __init__(self, path: str, text: str):
        self.path, self.at = path, 0
        self._lines = text.replace("{", " { ").replace("}", " } ").splitlines()
        self._words = [(number, word) for number, line in enumerate(self._lines, 1) for word in line.split()]

    def next(self, expected: str) -> str:
        """Return the next word in upper case."""
        if self.at == len(self._words):
            raise OsikValueError(f"{self.path} ends where {expected} should come")
        self.at += 1
        return self._words[self.at - 1][1].upper()

    def take(self, expected: str) -> None:
        """Go past a word, which has to be the expected one."""
        if self.next(expected) != expected:
            raise self.error(f"{expected} should come here")

    def name(self) -> str:
        """Return the words up to the next brace, which name a joint."""
        found = [word for _, word in itertools.takewhile(lambda one: one[1] not in "{}", self._words[self.at :])]
        self.at += len(found)
        if not found:
            raise self.error("a joint has no name")
        return " ".join(found)

    def numbers(self, count: int) -> Float[np.ndarray, " count"]:
        """Return the next words as so many numbers."""
        return np.array([self._number(self.next(f"a number, of {count}")) for _ in range(count)])

    def rows(self, columns: int) -> Float[np.ndarray, "F C"]:
        """Return all remaining words as rows of ``columns`` numbers."""
        first, self.at = self.at, len(self._words)
        left = self._words[first:]
        if len(left) % columns:
            for number, own in itertools.groupby(left, key=lambda one: one[0]):
                if (size := len(list(own))) != columns:
                    raise self.error(f"a frame has {size} numbers where there should be {columns}", number)
        return np.array([self._number(word, number) for number, word in left]).reshape(-1, columns)

    def _number(self, word: str, number: int | None = None) -> float:
        value = as_number(word)
        if not abs(value) <= _LARGEST:
            raise self.error(f"{word} is no length and no angle: a number, up to {_LARGEST:g}", number)
        return value

    def error(self, what: str, number: int | None = None) -> ValueError:
        """Return an error that names a line: that of the word read last, or the given one."""
        number = self._words[self.at - 1][0] if number is None else number
        return OsikValueError(f"{self.path}, line {number}: {what}; it is {self._lines[number - 1].strip()[:60]!r}")
