"""Reader of BVH files: a tree of joints with offsets and channels, then one row of numbers per frame.

A BVH file states neither unit nor up axis. The caller gives them, or they are inferred from the rest pose.
"""

from __future__ import annotations

import codecs
import dataclasses
import itertools
import os
from collections.abc import Callable
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
_KEYWORDS = {"ROOT", "JOINT", "END", "OFFSET", "CHANNELS", "{", "}", "MOTION"}
_CHANNELS = {f"{axis}{kind}": (kind, axis.lower()) for axis in "XYZ" for kind in ("position", "rotation")}
_LARGEST = 1e8
"""Largest accepted absolute value of a length in any unit, or of an angle [deg]."""


@dataclasses.dataclass
class _Joint:
    """One joint of a BVH tree, in the file's axes and unit."""

    name: str
    parent: int
    offset: np.ndarray
    channels: tuple[tuple[str, str], ...] = ()
    is_end: bool = False


def read_bvh(
    path: str | os.PathLike[str], *, unit: str | float | None = None, up: Up | None = None, trim: bool = True
) -> HumanMotion:
    """Read a BVH file.

    A joint's rotation is the product of its channels in the order in which the file lists them. Ends of chains
    (``End Site``) become joints called ``PARENT_end`` unless their offset is 0. ``rest_positions`` is the pose with all
    rotations 0 and the root at the origin; None if nobody stands in it, as in files with all bones along one axis.
    Facing z with y up becomes facing x with z up.

    ``unit``, ``up``, ``trim`` and errors are those of ``load_motion``. If nobody stands in the rest pose, the
    length of the joints from a foot to the head gives the unit.
    """
    source, up = str(path), checked_up(up)
    words = _Words(source, _text(Path(path)))
    joints = _hierarchy(words)
    fps, values = _frames(words, sum(len(joint.channels) for joint in joints))
    parents, names = [joint.parent for joint in joints], tuple(joint.name for joint in joints)
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
    expected = rest_up or find_up(motion, "y")[0]
    motion = standing_up(source, motion, up, expected, rest_up)
    count = _rest_frames(motion) if trim else 0
    if not count:
        return motion
    warn(f"{source} begins with its rest pose ({count} of {motion.frames} frames), left out; trim=False keeps it")
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


def _text(path: Path) -> str:
    """Return the file's text: UTF-8 with invalid bytes replaced, or UTF-16 if it starts with a byte order mark."""
    content = path.read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if wide else "utf-8-sig", errors="replace")


def _hierarchy(words: _Words) -> list[_Joint]:
    """Return the joints of the tree, parents first."""
    if words.next("HIERARCHY").upper() != "HIERARCHY":
        raise words.error("a BVH file starts with HIERARCHY")
    joints: list[_Joint] = []
    inside: list[int] = []  # the joints whose braces are open
    while True:
        word = words.next("JOINT, End Site, } or MOTION")
        own = joints[inside[-1]] if inside else None
        match word.upper():
            case "ROOT" | "JOINT" | "END" as kind:
                if (kind == "ROOT") == bool(joints) or (kind == "ROOT") == bool(inside):
                    raise words.error("a skeleton is one ROOT, and every JOINT and End Site is inside it")
                if own is not None and own.is_end:
                    raise words.error("nothing is inside an End Site but its OFFSET")
                joints.append(_joint(words, kind, joints, inside[-1] if inside else -1))
                inside.append(len(joints) - 1)
            case "OFFSET" if own is not None:
                if not np.isnan(own.offset).any():
                    raise words.error(f"{own.name} has an OFFSET already")
                own.offset = words.offset()
            case "CHANNELS" if own is not None:
                if own.is_end or own.channels:
                    what = "an End Site has no CHANNELS" if own.is_end else f"{own.name} has CHANNELS already"
                    raise words.error(what)
                own.channels = _channels(words)
            case "}" if own is not None:
                if np.isnan(own.offset).any():
                    raise words.error(f"{own.name} has no OFFSET")
                inside.pop()
            case "MOTION" if joints and not inside:
                return joints
            case _:
                raise words.error(f"{word} is not expected here")


def _joint(words: _Words, kind: str, joints: list[_Joint], parent: int) -> _Joint:
    """Return a joint after reading its name and opening brace."""
    name = words.name()
    if kind == "END":
        name = f"{joints[parent].name}_end"
        name = name if all(joint.name != name for joint in joints) else f"{name}_{len(joints)}"
    if not name:
        raise words.error(f"{kind} has no name")
    if any(joint.name == name for joint in joints):
        raise words.error(f"a second joint is called {name}")
    if words.next("{") != "{":
        raise words.error(f"{{ should follow {name}")
    return _Joint(name, parent, np.full(3, np.nan), is_end=kind == "END")


def _channels(words: _Words) -> tuple[tuple[str, str], ...]:
    count, *names = words.up_to_keyword() or [""]
    if not count.isdigit() or int(count) != len(names):
        raise words.error("CHANNELS is followed by how many there are, and by their names")
    known = {name.lower(): value for name, value in _CHANNELS.items()}
    for name in names:
        if name.lower() not in known:
            raise words.error(f"no channel {name}; there are {', '.join(_CHANNELS)}")
    if len({name.lower() for name in names}) != len(names):
        raise words.error("a channel is named twice")
    return tuple(known[name.lower()] for name in names)


def _frames(words: _Words, channels: int) -> tuple[float, Float[np.ndarray, "F C"]]:
    """Return the frame rate [1/s] and one row of numbers per frame."""
    is_head = words.next("Frames:").lower().rstrip(":") == "frames"
    count = words.next("the number of frames")
    if not is_head or not count.isdigit():
        raise words.error("Frames: and their number should follow MOTION")
    if [words.next("Frame Time:").lower().rstrip(":") for _ in range(2)] != ["frame", "time"]:
        raise words.error("Frame Time: and seconds should follow Frames:")
    step = as_number(words.next("the frame time"))
    if not step > 0.0:
        raise words.error("the frame time has to be more than 0 s")
    if step > _SLOWEST:
        raise words.error("the frame time is in seconds, and from one frame to the next it is less than one")
    if step < _FASTEST:
        raise words.error(f"the frame time is {step:g} s; it is {_FASTEST:g} s at least")
    values = words.frames(int(count), channels)
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
                offsets[:, i, "xyz".index(axis)] = own[:, k]
        if turns:  # capital letters: about the axes that the earlier channels have turned
            order = "".join(joint.channels[k][1] for k in turns).upper()
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
        self.path, self._lines, self._at = path, text.splitlines(), 0
        spaced = (line.replace("{", " { ").replace("}", " } ").split() for line in self._lines)
        self._words = [(number, word) for number, line in enumerate(spaced, 1) for word in line]

    def next(self, expected: str) -> str:
        """Return the next word."""
        if self._at == len(self._words):
            raise OsikValueError(f"{self.path} ends where {expected} should come")
        self._at += 1
        return self._words[self._at - 1][1]

    def name(self) -> str:
        """Return the words up to the end of the present line, or up to a brace on it."""
        line = self._words[self._at - 1][0]
        return " ".join(self._take(lambda number, word: number == line and word != "{"))

    def up_to_keyword(self) -> list[str]:
        """Return the words up to the next keyword."""
        return self._take(lambda _, word: word.upper() not in _KEYWORDS)

    def _take(self, belongs: Callable[[int, str], bool]) -> list[str]:
        found = [word for _, word in itertools.takewhile(lambda one: belongs(*one), self._words[self._at :])]
        self._at += len(found)
        return found

    def offset(self) -> Float[np.ndarray, "3"]:
        """Return the numbers up to the next keyword, which are three."""
        size = len(self.up_to_keyword())
        values = self._checked(self._words[self._at - size : self._at], "OFFSET")
        if size != 3:
            raise self.error(f"OFFSET has {size} numbers where there should be 3")
        return values

    def frames(self, count: int, columns: int) -> Float[np.ndarray, "F C"]:
        """Return all remaining words as ``count`` rows of ``columns`` numbers."""
        left = self._words[self._at :]
        values = self._checked(left, "a frame")
        if len(left) != count * columns or not left:
            for number, own in itertools.groupby(left, key=lambda one: one[0]):
                size = len(list(own))
                if size != columns:
                    raise self.error(f"a frame has {size} numbers where there should be {columns}", number)
            raise self.error(f"the file says Frames: {count}, and has {len(left) // columns}")
        return values.reshape(count, columns)

    def _checked(self, words: list[tuple[int, str]], what: str) -> Float[np.ndarray, " n"]:
        try:
            values = np.array([float(word) for _, word in words])
        except ValueError:
            wrong = next(number for number, word in words if np.isnan(as_number(word)))
            raise self.error(f"{what} is not numbers", wrong) from None
        wrong = np.flatnonzero(~(np.abs(values) <= _LARGEST))
        if wrong.size:
            number, value = words[wrong[0]][0], values[wrong[0]]
            if not np.isfinite(value):
                raise self.error(f"{what} is not finite", number)
            raise self.error(f"{what} has a number over {_LARGEST:g}, which is no length and no angle", number)
        return values

    def error(self, what: str, number: int | None = None) -> ValueError:
        """Return an error that names a line: that of the word read last, or the given one."""
        read = self._words[max(min(self._at, len(self._words)) - 1, 0)][0] if self._words else 1
        number = read if number is None else number
        line = self._lines[number - 1].strip() if self._lines else ""
        return OsikValueError(f"{self.path}, line {number}: {what}; the line is {line[:60]!r}")
