"""Measurements from CSV."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from .._errors import OsikKeyError, OsikValueError
from ..numerics._columns import read_columns
from ..robot import Robot
from ..robot.loading._poses import rotation_matrix
from ._measurements import Distances, Measurement, Pixels, PlaneContacts, Points, Poses

_POSITION, _QUATERNION, _PIXEL = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("u", "v")


def read_measurements(
    path: str | os.PathLike[str],
    robot: Robot,
    frame: str,
    *,
    other: str | None = None,
    intrinsics: Sequence[float] | None = None,
    sigma: float | None = None,
    sigma_rotation: float = 1e-3,
) -> Measurement:
    """Read measurements of one kind from a CSV file, a reading a line.

    The head names the columns: joints of the robot [rad or m] (the others are as in ``q0``), and what was read:
    ``x, y, z`` [m] for points; with ``qw, qx, qy, qz`` for poses; ``distance`` [m]; ``height`` [m] over a plane; or
    ``u, v`` for pixels.

    Args:
        path: the file.
        robot: the robot.
        frame: the frame that was measured.
        other: the other frame of distances, the plane, or the camera.
        intrinsics: of the camera: fx, fy, cx, cy.
        sigma: standard deviation of the readings [m or pixels]; default: that of the measurement's class.
        sigma_rotation: of poses [rad].

    Raises:
        FileNotFoundError: no such file.
        KeyError: a column is no joint.
        ValueError: no columns of a kind, a missing ``other`` or ``intrinsics``, or a cell that is no number.
    """
    columns = read_columns(path)
    known = (*_POSITION, *_QUATERNION, *_PIXEL, "distance", "height")
    q = _configurations(robot, {name: values for name, values in columns.items() if name not in known}, str(path))
    noise = {} if sigma is None else {"sigma": sigma}

    def has(*names: str) -> bool:
        return set(names) <= set(columns)

    def table(*names: str) -> np.ndarray:
        return np.stack([columns[name] for name in names], -1)

    if has(*_POSITION, *_QUATERNION):
        turns = np.stack([rotation_matrix(row / np.linalg.norm(row)) for row in table(*_QUATERNION)])
        return Poses(frame, q, table(*_POSITION), turns, sigma_rotation=sigma_rotation, **noise)
    if has(*_POSITION):
        return Points(frame, q, table(*_POSITION), **noise)
    if not any(has(name) for name in ("distance", "height", "u")):
        raise OsikValueError(f"{path}: no columns of a kind: x,y,z; x,y,z,qw,qx,qy,qz; distance; height; or u,v")
    if other is None:
        raise OsikValueError(f"{path}: name the other frame of distances, the plane of heights or the camera, other=")
    if has(*_PIXEL):
        if intrinsics is None:
            raise OsikValueError(f"{path}: pixels need the camera's intrinsics=(fx, fy, cx, cy)")
        return Pixels(frame, other, q, table(*_PIXEL), intrinsics, **noise)
    if has("distance"):
        return Distances(frame, other, q, columns["distance"], **noise)
    return PlaneContacts(frame, other, q, height=columns["height"], **noise)


def _configurations(robot: Robot, joints: dict[str, np.ndarray], path: str) -> np.ndarray:
    """Return configurations with some joints set. (n, nq)."""
    if not joints:
        raise OsikValueError(f"{path}: no column is a joint; joints: {', '.join(robot.joint_names)}")
    try:
        places = [robot.joint_qpos_index(name) for name in joints]
    except KeyError as error:
        raise OsikKeyError(f"{path}: {error}") from None
    q = np.tile(np.asarray(robot.q0, float), (len(next(iter(joints.values()))), 1))
    q[:, places] = np.stack(list(joints.values()), -1)
    return q
