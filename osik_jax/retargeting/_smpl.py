"""Reader of SMPL, SMPL-H and SMPL-X poses in the layout of AMASS: joint rotations and the root's position."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError
from ._motion import HumanMotion
from ._rotations import UNTURNED, continuous, forward

_TREE = (
    ("pelvis", -1, (0.0, 0.0, 0.0)),
    ("left_hip", 0, (0.09, -0.05, 0.0)),
    ("right_hip", 0, (-0.09, -0.05, 0.0)),
    ("spine1", 0, (0.0, 0.11, 0.0)),
    ("left_knee", 1, (0.0, -0.41, 0.0)),
    ("right_knee", 2, (0.0, -0.41, 0.0)),
    ("spine2", 3, (0.0, 0.13, 0.0)),
    ("left_ankle", 4, (0.0, -0.41, 0.0)),
    ("right_ankle", 5, (0.0, -0.41, 0.0)),
    ("spine3", 6, (0.0, 0.06, 0.0)),
    ("left_foot", 7, (0.0, -0.06, 0.13)),
    ("right_foot", 8, (0.0, -0.06, 0.13)),
    ("neck", 9, (0.0, 0.21, 0.0)),
    ("left_collar", 9, (0.07, 0.12, 0.0)),
    ("right_collar", 9, (-0.07, 0.12, 0.0)),
    ("head", 12, (0.0, 0.08, 0.04)),
    ("left_shoulder", 13, (0.11, 0.03, 0.0)),
    ("right_shoulder", 14, (-0.11, 0.03, 0.0)),
    ("left_elbow", 16, (0.26, 0.0, 0.0)),
    ("right_elbow", 17, (-0.26, 0.0, 0.0)),
    ("left_wrist", 18, (0.25, 0.0, 0.0)),
    ("right_wrist", 19, (-0.25, 0.0, 0.0)),
)
"""Name, parent and offset [m] of the body's joints; y up, facing z, arms to the sides. The order is SMPL's; the lengths
are round numbers for a person of 1.7 m, not those of SMPL's mesh. Hand joints follow in files and are not used.
"""
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_REST = ("rest_joints", "J")
_ARRAYS = ("poses", "root_orient", "pose_body", "trans", *_RATES, *_REST)


def arrays_to_read(names: Collection[str]) -> Collection[str]:
    """Return those arrays of a file that its reader uses: of SMPL poses some, of other files all.

    AMASS's files for SMPL-X contain an array of objects, which cannot be read without unpickling it.
    """
    return [name for name in names if name in _ARRAYS] if is_smpl(names) else names


def is_smpl(names: Collection[str]) -> bool:
    """Return whether a file with arrays of these names holds poses of SMPL joints."""
    return "trans" in names and ("poses" in names or {"root_orient", "pose_body"} <= set(names))


def read_smpl(path: Path, arrays: Mapping[str, np.ndarray]) -> HumanMotion:
    """Return the motion in a file of SMPL, SMPL-H or SMPL-X poses.

    Bone lengths come from the file (``rest_joints`` or ``J``: joints in the rest pose [m], 22 body joints first).
    Without them they are those of a person of 1.7 m, because ``betas`` needs the model's own data. Rotation vectors are
    ``poses`` (F, 3 k) of k joints, 22 at least, or ``root_orient`` (F, 3) and ``pose_body`` (F, 63); ``trans`` (F, 3)
    is in metres; the rate is ``mocap_framerate``, ``mocap_frame_rate`` or ``fps``.
    """
    count = len(_TREE)
    poses = arrays["poses"] if "poses" in arrays else np.concatenate([arrays["root_orient"], arrays["pose_body"]], -1)
    trans, rate = arrays["trans"], next((arrays[name] for name in _RATES if name in arrays), None)
    if rate is None or np.size(rate) != 1:
        raise OsikValueError(f"{path} has no rate; poses come with one of {', '.join(_RATES)}")
    if poses.ndim != 2 or poses.shape[1] < 3 * count or poses.shape[1] % 3 or trans.shape != (len(poses), 3):
        raise OsikValueError(
            f"{path}: poses has shape {poses.shape} and trans {trans.shape}; they are (F, 3 k), k joints of {count} or "
            "more, and (F, 3)"
        )
    given = next((arrays[name] for name in _REST if name in arrays), None)
    if given is not None and (given.ndim != 2 or len(given) < count or given.shape[1] != 3):
        raise OsikValueError(f"{path}: joints of the rest pose have shape {given.shape}; they are ({count} or more, 3)")
    parents = [parent for _, parent, _ in _TREE]
    offsets = np.array([offset for _, _, offset in _TREE])
    root = np.asarray(trans, float)
    if given is not None:
        rest = np.asarray(given[:count], float)
        offsets = rest - np.where(np.array(parents)[:, None] >= 0, rest[parents], 0.0)
        root, offsets[0] = root + rest[0], 0.0
    for name, values in (("poses", poses), ("trans", trans), ("joints of the rest pose", offsets)):
        if not np.isfinite(np.asarray(values, float)).all():
            raise OsikValueError(f"{path}: {name} has numbers that are not finite")
    vectors = np.asarray(poses[:, : 3 * count], float).reshape(-1, 3)
    local = Rotation.from_rotvec(vectors).as_quat(scalar_first=True).reshape(-1, count, 4)
    positions, rotations = forward(parents, offsets, local)
    positions += root[:, None]
    rest, _ = forward(parents, offsets, np.tile(UNTURNED, (1, count, 1)))
    names = tuple(name for name, _, _ in _TREE)
    return HumanMotion(path.stem, float(np.ravel(rate)[0]), names, positions, continuous(rotations), rest[0])
