"""Reader for every kind of motion file: BVH, and joint positions or SMPL poses as arrays."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError
from .._npz import open_npz
from ._bvh import read_bvh
from ._motion import HumanMotion
from ._rotations import continuous
from ._smpl import arrays_to_read, is_smpl, read_smpl
from ._up import Up, checked_up, find_rest_up, standing_up

ENDINGS = (".bvh", ".npz")


def load_motion(path: str | os.PathLike[str], *, unit: str | float | None = None, up: Up | None = None) -> HumanMotion:
    """Read a person's motion: BVH or ``.npz``, told apart by the ending.

    A ``.npz`` has ``fps``, ``positions`` (F, J, 3) in metres, z up, and ``joint_names`` (J,); optional ``rotations``
    (F, J, 4; w x y z), ``rest_positions`` (J, 3), ``contact`` (F, 4; left heel, left toe, right heel, right toe, or
    F, 2; left, right), ``ground``, ``object.NAME`` (F, 7; position and w x y z) and ``touch.ROLE.NAME`` (F,). One with
    ``poses`` and ``trans`` is read as in AMASS (SMPL, SMPL-H or SMPL-X). Nothing is unpickled.

    Rest-pose frames at the start of a BVH file, followed by a jump, are left out with an ``OsikWarning``.

    Args:
        path: the file.
        unit: length of one unit of a BVH file [m], or ``"m"``, ``"cm"``, ``"mm"``, ``"inch"``, ``"cmu"``. None: the one
            of these in which the person is 1 to 2.3 m large. Other files are in metres.
        up: the file's axis that points up: ``"x"``, ``"y"``, ``"z"``, ``"-x"``, ``"-y"`` or ``"-z"``. None: the axis
            along which the person stands in the motion. An ``OsikWarning`` is given if the rest pose disagrees.

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
        return read_bvh(path, unit=unit, up=up)
    up = checked_up(up)
    motion = _from_npz(Path(path))
    return standing_up(str(path), motion, up, "z", find_rest_up(motion))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a ``.npz`` file that have a use (``arrays_to_read``); nothing is unpickled."""
    if not path.is_file():
        raise FileNotFoundError(f"no such file: {path}")
    with open_npz(path) as data:
        return {name: data[name] for name in arrays_to_read(data.files)}


def check_has(path: Path, arrays: dict[str, np.ndarray], *names: str) -> None:
    """Raise ValueError if a file lacks an array."""
    missing = [name for name in names if name not in arrays]
    if missing:
        raise OsikValueError(f"{path} has no {', '.join(missing)}; it has {', '.join(arrays) or 'nothing'}")


def _from_npz(path: Path) -> HumanMotion:
    arrays = load_arrays(path)
    if is_smpl(arrays):
        return read_smpl(path, arrays)
    check_has(path, arrays, "fps", "positions", "joint_names")
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
