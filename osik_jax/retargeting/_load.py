"""Reader for every kind of motion file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from .._errors import OsikValueError
from ._bvh import read_bvh
from ._keypoints import read_keypoints
from ._motion import HumanMotion
from ._up import Up

ENDINGS = (".bvh", ".npz")


def load_motion(
    path: str | os.PathLike[str], *, unit: str | float | None = None, up: Up | None = None, trim: bool = True
) -> HumanMotion:
    """Read a person's motion: BVH or ``.npz``, told apart by the ending.

    Args:
        path: the file.
        unit: length of one unit of a BVH file [m], or ``"m"``, ``"cm"``, ``"mm"``, ``"inch"``, ``"cmu"``. None: the one
            of these in which the person is 1 to 2.3 m large. Other files are in metres.
        up: the file's axis that points up: ``"x"``, ``"y"``, ``"z"``, ``"-x"``, ``"-y"`` or ``"-z"``. None: the axis
            along which the person stands in the motion. An ``OsikWarning`` is given if the rest pose disagrees.
        trim: leave out rest-pose frames at the start of a BVH file, with an ``OsikWarning``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another ending, ``unit`` with keypoints (they are metres), or a broken file: the message says where,
            and what is wrong.
        KeyError: no such unit.
    """
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS and (ending or Path(path).exists()):  # a misspelt folder has no ending, and is missing
        raise OsikValueError(f"{path} is none of {', '.join(ENDINGS)}")
    if unit is not None and ending in ENDINGS and ending != ".bvh":
        raise OsikValueError("unit goes with BVH files; keypoints are metres")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no such file: {path}")
    if ending == ".bvh":
        return read_bvh(path, unit=unit, up=up, trim=trim)
    return read_keypoints(path, up=up)


def clips_in(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Return the motion files of a folder by clip name, and the names of what else is in it.

    A clip's name is the file's, without its ending unless two would clash. Hidden files are not named.
    """
    inside = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    files = [path for path in inside if path.is_file() and path.suffix.lower() in ENDINGS]
    others = [path.name + "/" * path.is_dir() for path in inside if path not in files]
    if not files:
        seen = shortened([path.name for path in inside]) or "nothing"
        raise OsikValueError(f"{folder} has no clips ({', '.join(ENDINGS)}); in it: {seen}")
    stems = [path.stem for path in files]
    return {path.stem if stems.count(path.stem) == 1 else path.name: path for path in files}, others


def shortened(names: Sequence[str], most: int = 8) -> str:
    """Return names joined by commas, ``most`` of them and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
