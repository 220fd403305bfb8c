"""Equality constraints of a MuJoCo model that are not in a robot's tree: closed loops and polynomial couplings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from ._mjmodel import element_names, equality_end_sites
from ._poses import rotation_matrix

KINDS = {
    int(mujoco.mjtEq.mjEQ_CONNECT): "connect",
    int(mujoco.mjtEq.mjEQ_WELD): "weld",
    int(mujoco.mjtEq.mjEQ_JOINT): "joint",
}


class Ends(NamedTuple):
    """The two ends of a connect or weld."""

    frames: tuple[str, str]  # names of the frames that they are fixed to
    anchors: np.ndarray  # points that meet, in these frames [m]. (2, 3)
    # rotation of a weld, from the axes in which the second frame should be to the first frame's. (3, 3)
    relative: np.ndarray


def is_in_tree(model: mujoco.MjModel, e: int) -> bool:
    """Return whether the robot's coupled joints contain the constraint: active, on joints, of degree at most 1."""
    if int(model.eq_type[e]) != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e]:
        return False
    return int(model.eq_obj2id[e]) < 0 or not model.eq_data[e, 2:5].any()


def constraint_ends(model: mujoco.MjModel, frame_names: Sequence[str], e: int) -> Ends:
    """Return the ends of a connect or weld; ``frame_names`` are the robot's frames."""
    ids = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e])]
    bodies = element_names(model, "body")
    if model.eq_objtype[e] != mujoco.mjtObj.mjOBJ_SITE:
        anchors = model.eq_data[e, :6].reshape(2, 3)
        weld = int(model.eq_type[e]) == mujoco.mjtEq.mjEQ_WELD  # whose anchors are in the other order
        relative = rotation_matrix(model.eq_data[e, 6:10]) if weld else np.eye(3)
        return Ends((bodies[ids[0]], bodies[ids[1]]), anchors[::-1] if weld else anchors, relative)
    if set(ids) <= equality_end_sites(model):
        first, second = (rotation_matrix(model.site_quat[i]) for i in ids)
        owners = [bodies[model.site_bodyid[i]] for i in ids]
        return Ends((owners[0], owners[1]), model.site_pos[ids], first @ second.T)
    names = [model.site(i).name for i in ids]
    frames = [f"site:{name}" if f"site:{name}" in frame_names else name for name in names]
    return Ends((frames[0], frames[1]), np.zeros((2, 3)), np.eye(3))
