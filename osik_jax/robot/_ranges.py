"""Ranges of joints: configurations inside them, and warnings about numbers that are probably in other units."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from .._errors import warn
from ..numerics._host import Numbers, module_of
from ._model import RobotModel
from ._tree import BALL, FREE, HINGE, SLIDE, KinematicTree

_FAR = 0.5
"""A joint that is further outside its range [rad or m] than this is not there: encoders are off by a hundredth."""
_TIMES = 10.0
"""A speed that is more times the file's is not meant: degrees are 57 times radians, millimetres 1000 times metres."""


def independent_balls(tree: KinematicTree) -> list[int]:
    """Return ball joints that own entries of q and v."""
    return [joint for joint in tree.independent if tree.joint_types[joint] == BALL]


def ball_rotation(quaternion: Float[Numbers, "4"]) -> tuple[Float[Numbers, ""], Float[Numbers, "3"]]:
    """Return the angle [rad], from 0 to pi, and the axis of the rotation of a quaternion w x y z.

    The axis of no rotation is zero. The axis is the same in the joint's body and in the body before it, and along it
    the angle grows at the rate of the angular velocity.
    """
    xp = module_of(quaternion)
    part = quaternion[1:] * xp.where(quaternion[0] < 0.0, -1.0, 1.0)
    squared = (part**2).sum()
    still = squared <= jnp.finfo(quaternion.dtype).tiny
    length = xp.sqrt(xp.where(still, 1.0, squared))
    angle = xp.where(still, 0.0, 2.0 * xp.arctan2(length, abs(quaternion[0])))
    return angle, xp.where(still, 0.0, part / length)


def with_balls_inside(
    tree: KinematicTree, q: Float[Numbers, " nq"], upper: Float[Numbers, " nv"]
) -> Float[Numbers, " nq"]:
    """Return the configuration with ball joints turned back along their axis to the end of their range.

    ``upper`` has the greatest angle [rad] in the three entries of each ball joint; inf where free.
    """
    xp = module_of(q)
    for joint in independent_balls(tree):
        at, greatest = tree.qpos_address[joint], upper[tree.dof_address[joint]]
        angle, axis = ball_rotation(q[at : at + 4])
        half = 0.5 * xp.where(xp.isinf(greatest), 0.0, greatest)
        end = xp.concatenate([xp.cos(half)[None], xp.sin(half) * axis])
        q = xp.concatenate([q[:at], xp.where(angle > greatest, end, q[at : at + 4]), q[at + 4 :]])
    return q


def inside(
    tree: KinematicTree, q: Float[np.ndarray, " nq"], lower: Float[np.ndarray, " nv"], upper: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, " nq"]:
    """Return the configuration with joints brought to the nearest ends of their ranges."""
    q = q.copy()
    for joint, start in tree.qpos_address.items():
        if tree.joint_types[joint] in (HINGE, SLIDE):
            dof = tree.dof_address[joint]
            q[start] = np.clip(q[start], lower[dof], upper[dof])
    return with_balls_inside(tree, q, upper)


def joints_outside(
    tree: KinematicTree,
    q: Float[np.ndarray, " nq"],
    lower: Float[np.ndarray, " nv"],
    upper: Float[np.ndarray, " nv"],
    tolerance: float,
) -> dict[int, str]:
    """Return the joints that are outside their range by more than a tolerance [rad or m], and where each is."""
    found = {}
    for joint, start in tree.qpos_address.items():
        kind, dof = tree.joint_types[joint], tree.dof_address[joint]
        if kind == FREE:
            continue
        low, high, value, said = float(lower[dof]), float(upper[dof]), float(q[start]), "is"
        if kind == BALL:
            low, value, said = 0.0, float(ball_rotation(q[start : start + 4])[0]), "is turned by"
        if not low - tolerance <= value <= high + tolerance:
            found[joint] = f"{tree.joint_names[joint]} {said} {value:g}, its range is [{low:g}, {high:g}]"
    return found


def warn_of_far_joints(robot: RobotModel, q: Any, what: str) -> None:
    """Give one ``OsikWarning`` that names the joints of q (nq,) that are far outside their range.

    Nothing is said of traced numbers.
    """
    parts = (q, robot.position_lower, robot.position_upper)
    if any(isinstance(part, Tracer) for part in parts):
        return
    values, lower, upper = map(np.asarray, parts)
    far = joints_outside(robot.tree, values, lower, upper, _FAR)
    if far:
        warn(f"{what} is far outside the joints' ranges; it is in radians and metres: {first_of(list(far.values()))}")


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
