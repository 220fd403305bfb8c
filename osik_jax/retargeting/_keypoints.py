"""Reader of keypoint files: joint positions as arrays (.npz) or as a table (.csv)."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError
from .._npz import open_npz
from ._motion import CONTACT_POINTS, LARGEST, HumanMotion, as_number
from ._optitrack import is_optitrack, read_optitrack
from ._rotations import continuous
from ._smpl import arrays_to_read, is_smpl, read_smpl
from ._up import Up, checked_up, find_rest_up, standing_up

_AXES = ("x", "y", "z")


def read_keypoints(path: str | os.PathLike[str], *, up: Up | None = None) -> HumanMotion:
    """Read ``.npz`` or ``.csv`` keypoints [m], z up.

    ``.npz``: ``fps``, ``positions`` (F, J, 3), ``joint_names`` (J,); optional ``rotations`` (F, J, 4; w x y z),
    ``rest_positions`` (J, 3), ``contact`` (F, 4; left heel, left toe, right heel, right toe, or F, 2; left, right),
    ``ground``, ``object.NAME`` (F, 7; position and w x y z) and ``touch.ROLE.NAME`` (F,). Nothing is
    unpickled.

    ``.csv``: a header line with ``time`` and ``NAME.x``, ``NAME.y``, ``NAME.z`` of each joint, optionally
    ``contact.left_heel`` and so on (0 or 1); then one line per frame at a constant rate.

    A ``.npz`` with ``poses`` and ``trans`` is read as in AMASS (SMPL, SMPL-H or SMPL-X). A ``.csv`` that starts with
    ``Format Version`` is read as an export of OptiTrack Motive, whose default is y up.

    ``up`` and errors are those of ``load_motion``.
    """
    up, source = checked_up(up), Path(path)
    if str(path).lower().endswith(".csv"):
        motion, expected = _from_csv(source)
    else:
        motion, expected = _from_npz(source), "z"
    return standing_up(str(path), motion, up, expected, find_rest_up(motion))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a ``.npz`` file that have a use (``arrays_to_read``); nothing is unpickled."""
    if not path.is_file():
        raise FileNotFoundError(f"no such file: {path}")
    with open_npz(path) as data:
        return {name: data[name] for name in arrays_to_read(data.files)}


def _from_npz(path: Path) -> HumanMotion:
    arrays = load_arrays(path)
    if is_smpl(arrays):
        return read_smpl(path, arrays)
    missing = [name for name in ("fps", "positions", "joint_names") if name not in arrays]
    if missing:
        raise OsikValueError(f"{path} has no {', '.join(missing)}; it has {', '.join(arrays) or 'nothing'}")
    contact = _numbers(path, arrays, "contact")
    if contact is not None and not np.isin(contact, (0.0, 1.0)).all():
        raise OsikValueError(f"{path}: contact is 0 or 1, not {contact[~np.isin(contact, (0.0, 1.0))][0]:g}")
    if contact is not None and contact.ndim == 2 and contact.shape[1] == 2:
        contact = contact[:, [0, 0, 1, 1]]
    rotations = _numbers(path, arrays, "rotations")
    ground = _numbers(path, arrays, "ground")
    try:
        return HumanMotion(
            name=path.stem,
            fps=float(_number(path, arrays, "fps")),
            joint_names=tuple(str(name) for name in arrays["joint_names"].ravel()),
            positions=_numbers(path, arrays, "positions"),
            rotations=None if rotations is None else continuous(rotations),
            rest_positions=_numbers(path, arrays, "rest_positions"),
            contact=None if contact is None else contact.astype(bool),
            ground=None if ground is None else float(_number(path, arrays, "ground")),
            objects={name[7:]: _numbers(path, arrays, name) for name in arrays if name.startswith("object.")},
            touches=tuple(
                (parts[1], parts[2], held.astype(bool))
                for name, held in arrays.items()
                if len(parts := name.split(".", 2)) == 3 and parts[0] == "touch"
            ),
        )
    except ValueError as error:
        raise OsikValueError(f"{path}: {error}" if str(path) not in str(error) else str(error)) from None


def _numbers(path: Path, arrays: dict[str, np.ndarray], name: str) -> Any:
    """Return an array as floats, or None if the file has none of this name."""
    if name not in arrays:
        return None
    if arrays[name].dtype.kind not in "fiub":
        raise OsikValueError(f"{path}: {name} is of type {arrays[name].dtype}; it has to be numbers")
    return arrays[name].astype(float)


def _number(path: Path, arrays: dict[str, np.ndarray], name: str) -> float:
    values = np.ravel(_numbers(path, arrays, name))
    if values.size != 1:
        raise OsikValueError(f"{path}: {name} is one number, not {values.size}")
    return float(values[0])


def _from_csv(path: Path) -> tuple[HumanMotion, Up]:
    """Return the motion in a CSV table, and the up axis expected of this kind of table."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            # a spreadsheet writes an empty line as commas
            rows = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(map(str.strip, row))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise OsikValueError(f"{path} is no table in UTF-8: {error}") from None
    if len(rows) < 3:
        raise OsikValueError(f"{path} has {len(rows)} lines; it needs one of headings and two of numbers at least")
    if is_optitrack(rows):
        return read_optitrack(path, rows), "y"
    headings = _without_empty_end([name.strip() for name in rows[0][1]])
    names = _joints(path, headings)
    values = np.array([_row(path, number, row, headings) for number, row in rows[1:]])
    column = {name: i for i, name in enumerate(headings)}
    positions = np.stack([values[:, [column[f"{name}.{axis}"] for axis in _AXES]] for name in names], 1)
    flags = [f"contact.{point}" for point in CONTACT_POINTS]
    known = all(flag in column for flag in flags)
    motion = HumanMotion(
        name=path.stem,
        fps=_rate(path, values[:, column["time"]], [number for number, _ in rows[1:]]),
        joint_names=names,
        positions=positions,
        contact=values[:, [column[flag] for flag in flags]] > 0.5 if known else None,
    )
    return motion, "z"


def _joints(path: Path, headings: list[str]) -> tuple[str, ...]:
    """Return the joints for which the headings have all three coordinates."""
    if "time" not in headings:
        raise OsikValueError(f"{path}, line 1: no column is called time; columns: {', '.join(headings)}")
    twice = sorted({name for name in headings if headings.count(name) > 1})
    if twice:
        raise OsikValueError(f"{path}, line 1: columns occur twice: {', '.join(twice)}")
    others = [name for name in headings if name != "time" and not name.startswith("contact.")]
    names = tuple(dict.fromkeys(name.rpartition(".")[0] for name in others))
    expected = {f"{name}.{axis}" for name in names for axis in _AXES}
    wrong = sorted(expected.symmetric_difference(others))
    if wrong or not names:
        raise OsikValueError(
            f"{path}, line 1: a joint has the three columns NAME.x, NAME.y and NAME.z; missing or of no joint: "
            f"{', '.join(wrong) or 'all'}"
        )
    return names


def _without_empty_end(cells: list[str], least: int = 0) -> list[str]:
    """Return cells without the empty ones at the end of their line; ``least`` cells are kept."""
    while len(cells) > least and not cells[-1].strip():
        cells = cells[:-1]
    return cells


def _row(path: Path, number: int, row: list[str], headings: list[str]) -> list[float]:
    row = _without_empty_end(row, len(headings))
    if len(row) != len(headings):
        raise OsikValueError(f"{path}, line {number}: {len(row)} values, but there are {len(headings)} headings")
    out = []
    for heading, text in zip(headings, row, strict=True):
        value = as_number(text)
        if not abs(value) <= LARGEST:
            raise OsikValueError(
                f"{path}, line {number}, column {heading}: {text!r} is no finite number up to {LARGEST:g}"
            )
        out.append(value)
    return out


def _rate(path: Path, time: np.ndarray, lines: list[int]) -> float:
    """Return the frame rate [1/s]; raise ValueError unless the times are evenly spaced to a tenth of a step."""
    steps = np.diff(time)
    step = np.median(steps)
    # files round their times, so a tenth of a step is allowed; more is a gap
    uneven = np.flatnonzero((np.abs(steps - step) > 0.1 * abs(step)) | (steps <= 0.0))
    if uneven.size:
        where = lines[int(uneven[0]) + 1]
        raise OsikValueError(
            f"{path}, line {where}: the time steps by {steps[uneven[0]]:.4g} s, elsewhere by {step:.4g} s"
        )
    return float(len(steps) / (time[-1] - time[0]))
