"""Reader of ASF skeletons and AMC motions, the file formats of the CMU motion capture database."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError
from ._motion import HumanMotion, finite_numbers
from ._rotations import UNTURNED, continuous, forward

# an inch [m]; an ASF unit is an inch over the file's ``length``
_INCH = 0.0254
_FPS = 120.0
"""Frame rate of the CMU database [1/s]; the AMC format does not store a rate."""
_AXES = ("x", "y", "z")


@dataclasses.dataclass
class _Bone:
    """One bone of an ASF skeleton, in file units: parent, rest vector to its end, joint axes and names of its dofs."""

    name: str
    parent: str = ""
    offset: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    axes: Rotation = dataclasses.field(default_factory=Rotation.identity)
    dofs: tuple[str, ...] = ()


def read_amc(path: Path) -> HumanMotion:
    """Return the motion in an AMC file. Each joint is placed at the start of the bone of the same name; y points up.

    Its skeleton is the ASF file beside it with whose name its own begins, or the only one.
    """
    bones, scale, degrees = _read_asf(_skeleton_beside(path))
    frames, names = _read_frames(path, bones), list(bones)
    angles, moves = (np.zeros((len(frames), len(bones), 3)) for _ in range(2))
    for i, (name, bone) in enumerate(bones.items()):
        for k, dof in enumerate(bone.dofs):
            if dof[1:] in _AXES:
                (angles if dof[0] == "r" else moves)[:, i, _AXES.index(dof[1:])] = [frame[name][k] for frame in frames]
    # angles are about the bone's own axes: conjugation turns them into the world's
    turns = [
        bone.axes * Rotation.from_euler("xyz", angles[:, i], degrees=degrees) * bone.axes.inv()
        for i, bone in enumerate(bones.values())
    ]
    local = np.stack([turn.as_quat(scalar_first=True) for turn in turns], 1)
    parents = [names.index(bone.parent) if bone.parent else -1 for bone in bones.values()]
    # a bone starts where its parent ends; bones of the root start at the root
    starts = np.array([bones[names[k]].offset if k > 0 else np.zeros(3) for k in parents])
    moves[:, 1:], moves[:, 0] = starts[1:], moves[:, 0] + bones["root"].offset
    positions, rotations = forward(parents, moves, local)
    rest = forward(parents, starts, np.tile(UNTURNED, (1, len(bones), 1)))[0][0]
    return HumanMotion(path.stem, _FPS, tuple(bones), scale * positions, continuous(rotations), scale * rest)


def _skeleton_beside(path: Path) -> Path:
    found = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() == ".asf"]
    named = [file for file in found if path.stem.startswith(file.stem)]
    if named:
        return max(named, key=lambda file: len(file.stem))
    if len(found) == 1:
        return found[0]
    raise OsikValueError(f"{path} needs its skeleton, an .asf file beside it; there are {len(found)}")


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    text = path.read_text(encoding="utf-8", errors="replace")
    rows = [(number, line.split("#")[0].split()) for number, line in enumerate(text.splitlines(), 1)]
    return [(number, words) for number, words in rows if words]


def _read_asf(path: Path) -> tuple[dict[str, _Bone], float, bool]:
    """Return the bones (parents first), the length of one file unit [m], and whether angles are in degrees."""
    bones, section, children = {"root": _Bone("root")}, "", []
    scale, degrees, name, along, length = _INCH, True, "root", np.zeros(3), 0.0
    for number, words in _lines(path):
        key, rest = words[0].lower(), words[1:]
        if key.startswith(":"):
            section = key
        elif section == ":units" and key == "length":
            scale = _INCH / finite_numbers(path, number, rest[:1])[0]
        elif section == ":units" and key == "angle":
            degrees = rest[:1] != ["rad"]
        elif section == ":root" and key == "order":
            bones["root"].dofs = tuple(word.lower() for word in rest)
        elif section == ":root" and key == "position":
            bones["root"].offset = np.array(finite_numbers(path, number, rest[:3]))
        elif section == ":root" and key == "orientation":
            bones["root"].axes = Rotation.from_euler("xyz", finite_numbers(path, number, rest[:3]), degrees=degrees)
        elif section == ":bonedata" and key == "name":
            name = rest[0]
            bones[name] = _Bone(name)
        elif section == ":bonedata" and key == "direction":
            along = np.array(finite_numbers(path, number, rest[:3]))
        elif section == ":bonedata" and key == "length":
            length = finite_numbers(path, number, rest[:1])[0]
        elif section == ":bonedata" and key == "axis":
            order = rest[3].lower() if len(rest) > 3 else "xyz"
            bones[name].axes = Rotation.from_euler(order, finite_numbers(path, number, rest[:3]), degrees=degrees)
        elif section == ":bonedata" and key == "dof":
            bones[name].dofs = tuple(word.lower() for word in rest)
        elif section == ":bonedata" and key == "end":
            bones[name].offset = length * along / max(float(np.linalg.norm(along)), 1e-12)
        elif section == ":hierarchy" and key not in ("begin", "end"):
            unknown = [word for word in words if word not in bones]
            if unknown:
                raise OsikValueError(f"{path}, line {number}: no bone {unknown[0]}; bones: {', '.join(bones)}")
            children.append(words)
    ordered = {"root": bones["root"]}
    for parent, *own in children:
        for child in own:
            bones[child].parent = parent
            ordered[child] = bones[child]
    late = [bone.name for bone in ordered.values() if bone.parent and bone.parent not in ordered]
    if len(ordered) < 2 or late:
        raise OsikValueError(f"{path}: the hierarchy does not connect {', '.join(late) or 'any bone'} to the root")
    return ordered, scale, degrees


def _read_frames(path: Path, bones: dict[str, _Bone]) -> list[dict[str, list[float]]]:
    frames: list[dict[str, list[float]]] = []
    moving = [name for name, bone in bones.items() if bone.dofs]
    for number, words in _lines(path):
        if words[0].startswith(":"):
            continue
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif not frames or words[0] not in bones or len(words) - 1 != len(bones[words[0]].dofs):
            raise OsikValueError(
                f"{path}, line {number}: {words[0]} with {len(words) - 1} numbers is not expected here"
            )
        else:
            frames[-1][words[0]] = finite_numbers(path, number, words[1:])
    for number, frame in enumerate(frames, 1):
        missing = [name for name in moving if name not in frame]
        if missing:
            raise OsikValueError(f"{path}: frame {number} has no {', '.join(missing)}")
    if not frames:
        raise OsikValueError(f"{path} has no frames")
    return frames
