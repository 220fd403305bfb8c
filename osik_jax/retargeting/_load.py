"""One function for every kind of motion file."""

from __future__ import annotations

import os
from pathlib import Path

from .._errors import OsikValueError
from ._bvh import Up, read_bvh
from ._keypoints import read_keypoints
from ._motion import HumanMotion


def load_motion(path: str | os.PathLike[str], *, unit: str | float | None = None, up: Up | None = None) -> HumanMotion:
    """Reads a person's motion: BVH, or keypoints as ``.npz`` or ``.csv``, told apart by the file's ending.

    Args:
        path: the file.
        unit: of a BVH, see ``read_bvh``.
        up: of a BVH, see ``read_bvh``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another ending, ``unit`` or ``up`` with keypoints (they are metres, z up), or a broken file: the
            message says where, and what is wrong.
        KeyError: no such unit.
    """
    ending = Path(path).suffix.lower()
    if ending == ".bvh":
        return read_bvh(path, unit=unit, up=up)
    if ending not in (".npz", ".csv"):
        raise OsikValueError(f"{path} is none of .bvh, .npz and .csv")
    if unit is not None or up is not None:
        raise OsikValueError("unit and up go with BVH files; keypoints are metres, z up")
    return read_keypoints(path)
