"""Poses in CSV files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError
from ..numerics._columns import read_columns

_POSITION, _POSE = ("x", "y", "z"), ("x", "y", "z", "qw", "qx", "qy", "qz")


def read_pose_file(path: Path) -> Any:
    """Return the positions of a file, and the quaternions w x y z if it has them.

    Raises:
        ValueError: other columns than x, y, z, or x, y, z, qw, qx, qy, qz. Without a head they have this order.
    """
    columns = read_columns(path, _POSE)
    if set(columns) not in (set(_POSITION), set(_POSE)):
        raise OsikValueError(f"{path}: its columns are {','.join(columns)}; they are x,y,z or x,y,z,qw,qx,qy,qz")
    rows = np.stack([columns[name] for name in _POSE if name in columns], -1)
    return rows if len(columns) == 3 else (rows[:, :3], rows[:, 3:])
