"""Keyframes of a MuJoCo model as home configurations."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from .._load_report import LoadNote
from .._ranges import joints_outside
from .._tree import KinematicTree

_KEY_ROUNDING = 1e-3
"""Distance by which a keyframe's joint may be outside its range [rad or m]: files are rounded."""


def keyframe_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of the keyframes; one without a name is called by its number."""
    return [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, k) or str(k) for k in range(model.nkey)]


def home_notes(
    tree: KinematicTree, key: str, q: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> Iterator[LoadNote]:
    """Yield notes on the joints that a keyframe has outside their range."""
    for text in joints_outside(tree, q, lower, upper, _KEY_ROUNDING).values():
        yield LoadNote("keyframe", key, f"{text}: in q0 it is at the end of that")
