"""Reader of CSV tables exported by OptiTrack Motive: bones of one person below five header lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .._errors import OsikValueError
from ._motion import HumanMotion, as_number
from ._rotations import continuous

_UNITS = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_FIRST = "Format Version"
_AXES = {"Position": "XYZ", "Rotation": "WXYZ"}

Rows = list[tuple[int, list[str]]]


def is_optitrack(rows: Rows) -> bool:
    """Return whether a table starts as an export of Motive does."""
    return rows[0][1][0].strip() == _FIRST


def read_optitrack(path: Path, rows: Rows) -> HumanMotion:
    """Return the motion in a table exported by Motive.

    Only bones are read, not markers or rigid bodies. A missing number raises ValueError with its line and column.
    ``rows`` has line number and cells of each line that is not empty.
    """
    head = dict(zip(rows[0][1][::2], rows[0][1][1::2], strict=False))
    unit, rate = head.get("Length Units", "Meters"), head.get("Export Frame Rate", "")
    if unit.lower() not in _UNITS:
        raise OsikValueError(f"{path}, line 1: Length Units is {unit}; it is Meters, Centimeters or Millimeters")
    if head.get("Coordinate Space", "Global") != "Global":
        raise OsikValueError(f"{path}, line 1: Coordinate Space is {head['Coordinate Space']}; export it as Global")
    first = next((i for i, (_, row) in enumerate(rows) if row[0].strip() == "Frame"), None)
    if first is None or first < 4:
        raise OsikValueError(f"{path}: there is no line of headings that begins with Frame, below those of the bones")
    labels = [[cell.strip() for cell in row] for _, row in rows[1 : first + 1]]
    types, names, kinds, axes = labels[0], labels[1], labels[-2], labels[-1]
    width = len(axes)
    if min(len(types), len(names), len(kinds)) < width:
        raise OsikValueError(f"{path}: the lines of headings do not have the same number of columns")
    places = {
        (names[c], kinds[c], axes[c]): c
        for c in range(2, width)
        if types[c] == "Bone" and kinds[c] in _AXES and axes[c] in _AXES[kinds[c]]
    }
    bones = tuple(dict.fromkeys(name for name, kind, _ in places if kind == "Position"))
    if not bones:
        raise OsikValueError(f"{path} has no bones; export a skeleton's bones, with positions in world coordinates")
    values = {}
    for kind, letters in _AXES.items():
        columns = [places.get((bone, kind, axis)) for bone in bones for axis in letters]
        if all(c is not None for c in columns):
            table = np.array([[_number(path, line, row, c) for c in columns] for line, row in rows[first + 1 :]])
            values[kind] = table.reshape(len(table), len(bones), len(letters))
    if "Position" not in values or not len(values["Position"]):
        raise OsikValueError(f"{path} has no frames, or bones without X, Y or Z")
    turns = values.get("Rotation")
    fps = float(rate) if rate else 1.0 / (_number(path, *rows[first + 2], 1) - _number(path, *rows[first + 1], 1))
    turns = None if turns is None else continuous(turns / np.linalg.norm(turns, axis=-1, keepdims=True))
    return HumanMotion(path.stem, fps, bones, _UNITS[unit.lower()] * values["Position"], turns)


def _number(path: Path, line: int, row: list[str], column: int | None) -> float:
    assert column is not None
    value = as_number("".join(row[column : column + 1]))
    if not np.isfinite(value):
        raise OsikValueError(f"{path}, line {line}, column {column + 1}: no finite number; fill gaps before exporting")
    return value
