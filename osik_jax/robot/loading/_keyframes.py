"""Keyframes of a MuJoCo model as home configurations."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from jax.core import Tracer

from ..._errors import warn
from .._balls import with_balls_inside
from .._load_report import LoadNote
from .._model import RobotModel
from .._plausible import first_of
from .._tree import FREE, HINGE, QPOS_WIDTH, SLIDE, KinematicTree

_KEY_ROUNDING = 1e-3
"""Distance by which a keyframe's joint may be outside its range [rad or m]: files are rounded."""


def keyframe_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of the keyframes; one without a name is called by its number."""
    return [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, k) or str(k) for k in range(model.nkey)]


def home_notes(tree: KinematicTree, key: str, qpos: np.ndarray, q0: np.ndarray) -> Iterator[LoadNote]:
    """Yield notes on the joints that a keyframe has outside their range."""
    changed = np.abs(qpos[tree.own_qpos] - q0) > _KEY_ROUNDING
    for joint, start in tree.qpos_address.items():
        kind = tree.joint_types[joint]
        if kind != FREE and changed[start : start + QPOS_WIDTH[kind]].any():
            there, here = (_shown(own, start, QPOS_WIDTH[kind]) for own in (qpos[tree.own_qpos], q0))
            done = f"{tree.joint_names[joint]} is {there} there, outside its range, and {here} in q0"
            yield LoadNote("keyframe", key, done)


def _shown(q: np.ndarray, start: int, width: int) -> str:
    """Return the entries of a joint as text."""
    return " ".join(f"{value:.4g}" for value in q[start : start + width])


def keyframe_home(robot: RobotModel, number: int) -> np.ndarray:
    """Return the configuration of a keyframe, joints brought inside their limits; warn of those that were outside."""
    model, tree = robot.mj_model, robot.tree
    qpos = model.key_qpos[number]
    if isinstance(robot.position_lower, Tracer):
        return qpos[tree.own_qpos]
    q0 = inside(qpos, tree, np.asarray(robot.position_lower), np.asarray(robot.position_upper))
    notes = list(home_notes(tree, keyframe_names(model)[number], qpos, q0))
    if notes:
        warn(first_of([str(note) for note in notes]))
    return q0


def inside(qpos: np.ndarray, tree: KinematicTree, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the independent entries of a full qpos, joints brought inside their limits."""
    q = qpos[tree.own_qpos]
    for joint, start in tree.qpos_address.items():
        if tree.joint_types[joint] in (HINGE, SLIDE):
            dof = tree.dof_address[joint]
            q[start] = np.clip(q[start], lower[dof], upper[dof])
    return with_balls_inside(tree, q, upper)
