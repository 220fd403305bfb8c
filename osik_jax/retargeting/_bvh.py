"""Reader of BVH files: a tree of joints with offsets and channels, then one row of numbers per frame.

A BVH file states neither unit nor up axis. The caller gives them, or they are inferred from the rest pose.
"""

from __future__ import annotations

import codecs
import dataclasses
import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._errors import OsikKeyError, OsikValueError, warn
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
_CHANNELS = {f"{axis}{kind}": (kind, axis.lower()) for axis in "XYZ" for kind in ("position", "rotation")}
_LARGEST = 1e8
"""Largest accepted absolute value of a length in any unit, or of an angle [deg]."""
_KEYWORDS = {"HIERARCHY", "ROOT", "JOINT", "OFFSET", "CHANNELS", "{", "}", "MOTION"}
_MOTION_KEYWORDS = {"FRAMES:", "FRAMES", "FRAME"}


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
    lines = Lines(source, _text(Path(path)))
    joints = _hierarchy(lines)
    fps, values = _frames(lines, sum(len(joint.channels) for joint in joints))
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


def _hierarchy(lines: Lines) -> list[_Joint]:
    if lines.next("HIERARCHY")[0].upper() != "HIERARCHY":
        raise lines.error("a BVH file starts with HIERARCHY")
    joints: list[_Joint] = []
    open_joints: list[int] = []
    while True:
        words = lines.next("JOINT, End Site, } or MOTION")
        word = words[0].upper()
        if word in ("ROOT", "JOINT") or (word, *map(str.upper, words[1:2])) == ("END", "SITE"):
            _check_place(lines, word, joints, open_joints)
            open_joints.append(_joint(lines, words, joints, open_joints[-1] if open_joints else -1))
        elif word == "OFFSET" and open_joints:
            joint = joints[open_joints[-1]]
            if not np.isnan(joint.offset).any():
                raise lines.error(f"{joint.name} has an OFFSET already")
            joint.offset = np.array(lines.numbers(words[1:], 3, "OFFSET"))
        elif word == "CHANNELS" and open_joints:
            joint = joints[open_joints[-1]]
            if joint.is_end or joint.channels:
                raise lines.error(
                    "an End Site has no CHANNELS" if joint.is_end else f"{joint.name} has CHANNELS already"
                )
            joint.channels = _channels(lines, words)
        elif word == "}" and open_joints:
            if np.isnan(joints[open_joints[-1]].offset).any():
                raise lines.error(f"{joints[open_joints[-1]].name} has no OFFSET")
            open_joints.pop()
        elif word == "MOTION" and joints and not open_joints:
            return joints
        else:
            raise lines.error(f"{words[0]} is not expected here")


def _check_place(lines: Lines, word: str, joints: list[_Joint], open_joints: list[int]) -> None:
    """Raise ValueError unless a joint may start here: exactly one ROOT, joints inside it, none inside an End Site."""
    if (word == "ROOT") == bool(joints) or (word == "ROOT") == bool(open_joints):
        raise lines.error("a skeleton is one ROOT, and every JOINT and End Site is inside it")
    if open_joints and joints[open_joints[-1]].is_end:
        raise lines.error("nothing is inside an End Site but its OFFSET")


def _joint(lines: Lines, words: list[str], joints: list[_Joint], parent: int) -> int:
    """Append a joint after reading its opening brace; return its index."""
    if words[0].upper() == "END":
        name = f"{joints[parent].name}_end"
        name = name if all(joint.name != name for joint in joints) else f"{name}_{len(joints)}"
    else:
        name = " ".join(words[1:])
    if not name:
        raise lines.error(f"{words[0]} has no name")
    if any(joint.name == name for joint in joints):
        raise lines.error(f"a second joint is called {name}")
    if lines.next("{") != ["{"]:
        raise lines.error(f"{{ should follow {name}")
    joints.append(_Joint(name, parent, np.full(3, np.nan), is_end=words[0].upper() == "END"))
    return len(joints) - 1


def _channels(lines: Lines, words: list[str]) -> tuple[tuple[str, str], ...]:
    if len(words) < 2 or not words[1].isdigit() or int(words[1]) != len(words) - 2:
        raise lines.error("CHANNELS is followed by how many there are, and by their names")
    known = {name.lower(): value for name, value in _CHANNELS.items()}
    for name in words[2:]:
        if name.lower() not in known:
            raise lines.error(f"no channel {name}; there are {', '.join(_CHANNELS)}")
    if len({name.lower() for name in words[2:]}) != len(words) - 2:
        raise lines.error("a channel is named twice")
    return tuple(known[name.lower()] for name in words[2:])


def _frames(lines: Lines, channels: int) -> tuple[float, Float[np.ndarray, "F C"]]:
    words = lines.next("Frames:")
    if words[0].lower() not in ("frames:", "frames") or not words[-1].isdigit():
        raise lines.error("Frames: and their number should follow MOTION")
    count = int(words[-1])
    words = lines.next("Frame Time:")
    if [word.lower().rstrip(":") for word in words[:2]] != ["frame", "time"]:
        raise lines.error("Frame Time: and seconds should follow Frames:")
    step = lines.numbers(words[2:], 1, "Frame Time")[0]
    if not step > 0.0:
        raise lines.error("the frame time has to be more than 0 s")
    if step > _SLOWEST:
        raise lines.error("the frame time is in seconds, and from one frame to the next it is less than one")
    if step < _FASTEST:
        raise lines.error(f"the frame time is {step:g} s; it is {_FASTEST:g} s at least")
    lines.rewrap(channels, count)
    rows = [lines.numbers(words, channels, "a frame") for words in lines.rest()]
    if len(rows) != count or not rows:
        raise lines.error(f"the file says Frames: {count}, and has {len(rows)}")
    fps = 1.0 / step
    # files round the frame time (0.0333333 s), so a rate within 0.01 of an integer is that integer
    return (float(round(fps)) if abs(fps - round(fps)) < 1e-2 else fps), np.array(rows)


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


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield each statement with its line number; a line may hold several statements, and a statement may span lines.

    A statement of the tree starts with a keyword. Behind MOTION each line of numbers is one.
    """
    statement: list[str] = []
    began, lines = 1, iter(enumerate(text.splitlines(), 1))
    for number, line in lines:
        words = line.replace("{", " { ").replace("}", " } ").split()
        for i, word in enumerate(words):
            # names may have spaces and keywords in them, up to the end of their line
            in_name = bool(statement) and statement[0].upper() in ("ROOT", "JOINT") and number == began
            keyword = word.upper() in _KEYWORDS or [w.upper() for w in words[i : i + 2]] == ["END", "SITE"]
            if not statement or word in ("{", "}") or (keyword and not in_name):
                if statement:
                    yield began, statement
                statement, began = [], number
            statement.append(word)
            if statement == [word] and word.upper() == "MOTION":
                yield number, statement
                yield from _behind_motion(itertools.chain([(number, " ".join(words[i + 1 :]))], lines))
                return
    if statement:
        yield began, statement


def _behind_motion(lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Yield the statements after MOTION: the number of frames, the frame time, and one row of numbers per frame."""
    for number, line in lines:
        words = line.split()
        starts = [i for i, word in enumerate(words) if word.upper() in _MOTION_KEYWORDS]
        for start, end in itertools.pairwise([0, *starts, len(words)]):
            part = words[start:end]
            size = 3 if [word.upper().rstrip(":") for word in part[:2]] == ["FRAME", "TIME"] else len(part)
            yield from ((number, some) for some in (part[:size], part[size:]) if some)


class Lines:
    """Iterator over the statements of a BVH file; its errors name the line."""

    def __init__(self, path: str, text: str):
        self.path, self._lines, self._at = path, list(_statements(text)), 0

    def next(self, expected: str) -> list[str]:
        """Return the words of the next statement."""
        if self._at == len(self._lines):
            raise OsikValueError(f"{self.path} ends where {expected} should come")
        self._at += 1
        return self._lines[self._at - 1][1]

    def rewrap(self, columns: int, count: int) -> None:
        """Split the remaining ``count * columns`` numbers into rows of ``columns``, wherever the file's lines end."""
        left = [(number, word) for number, words in self._lines[self._at :] for word in words]
        even = all(len(words) == columns for _, words in self._lines[self._at :])
        if not even and len(left) == count * columns:
            rows = (left[i : i + columns] for i in range(0, len(left), columns))
            self._lines[self._at :] = [(row[0][0], [word for _, word in row]) for row in rows]

    def error(self, what: str) -> ValueError:
        """Return an error that names the line read last."""
        number, words = self._lines[max(self._at - 1, 0)] if self._lines else (1, [])
        return OsikValueError(f"{self.path}, line {number}: {what}; the line is {' '.join(words)[:60]!r}")

    def rest(self) -> Iterator[list[str]]:
        """Yield the words of each remaining statement."""
        while self._at < len(self._lines):
            yield self.next("a frame")

    def numbers(self, words: list[str], count: int, what: str) -> list[float]:
        """Return words as ``count`` finite numbers, or raise ValueError that names the line read last."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise self.error(f"{what} is not numbers") from None
        if len(values) != count:
            raise self.error(f"{what} has {len(values)} numbers where there should be {count}")
        if not np.isfinite(values).all():
            raise self.error(f"{what} is not finite")
        if max(map(abs, values), default=0.0) > _LARGEST:
            raise self.error(f"{what} has a number over {_LARGEST:g}, which is no length and no angle")
        return values
