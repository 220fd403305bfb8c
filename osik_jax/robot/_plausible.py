"""Warnings about numbers that are probably not in radians, metres and seconds; they are used as given."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.core import Tracer

from .._errors import warn
from ._model import RobotModel
from ._tree import HINGE, SLIDE

_FAR = 0.5
"""A joint that is further outside its range [rad or m] than this is not there: encoders are off by a hundredth."""
_TIMES = 10.0
"""A speed that is more times the file's is not meant: degrees are 57 times radians, millimetres 1000 times metres."""


def warn_of_far_joints(robot: RobotModel, q: Any, what: str) -> None:
    """Give one ``OsikWarning`` that names the hinges and slides of q (nq,) that are far outside their range.

    Nothing is said of traced numbers.
    """
    parts = (q, robot.position_lower, robot.position_upper)
    if any(isinstance(part, Tracer) for part in parts):
        return
    values, lower, upper = (np.asarray(part) for part in parts)
    tree = robot.tree
    far = []
    for joint, at in tree.qpos_address.items():
        if tree.joint_types[joint] in (HINGE, SLIDE):
            low, high = (float(bound[tree.dof_address[joint]]) for bound in (lower, upper))
            if not low - _FAR <= values[at] <= high + _FAR:
                far.append(f"{tree.joint_names[joint]} is {values[at]:g}, its range is [{low:g}, {high:g}]")
    if far:
        warn(f"{what} is far outside the joints' ranges; it is in radians and metres: {first_of(far)}")


def warn_of_fast_joints(names: Any, given: Any, own: Any, what: str) -> None:
    """Give one ``OsikWarning`` that names the entries whose given speed is more than ten times the file's.

    Infinite speeds [rad/s or m/s] say that none is meant, or that the file has none.
    """
    if isinstance(given, Tracer) or isinstance(own, Tracer):
        return
    given, own = np.asarray(given), np.asarray(own)
    fast = np.flatnonzero(np.isfinite(given) & (given > _TIMES * own))
    if len(fast):
        shown = dict.fromkeys(f"{names[k]}: {given[k]:g}, the file has {own[k]:g}" for k in fast)
        warn(f"{what} is more than ten times the file's; it is in rad/s and m/s: {first_of(list(shown))}")


def first_of(texts: list[str], most: int = 4) -> str:
    """Return the first texts in a line, and the number of further ones."""
    more = f"; and {len(texts) - most} more" if len(texts) > most else ""
    return "; ".join(texts[:most]) + more
