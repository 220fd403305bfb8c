"""Conversion of a user's home configuration: start of the robot and default target of its posture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError, unknown_name, warn
from ..numerics._host import Numbers, module_of, on_host, replaced_at, to_jax
from ._configuration import check_configuration, with_joints
from ._model import RobotModel
from ._ranges import first_of, inside, joints_outside
from ._tree import QPOS_WIDTH
from .loading._notes import home_notes, keyframe_names

Home: TypeAlias = str | int | Mapping[str, Any] | ArrayLike | Array
"""A keyframe's name or number, a mapping from joint names to values, or a configuration (nq,)."""

_OUTSIDE = 1e-6
"""A value that is further out of its joint's range gets a warning [rad or m]; less is the rounding of a file."""


def home_configuration(robot: RobotModel, home: Home) -> Float[Array, " nq"]:
    """Return a checked home configuration with unit quaternions; warn of joints outside their range."""
    if isinstance(home, str) or _is_integer(home):
        q: Any = _keyframe(robot, home)
    elif isinstance(home, Mapping):
        q = _with_joints(robot, home)
    else:
        q = _as_array(home, robot.q0.dtype)
    check_configuration(robot, q, "home")
    q = _with_unit_quaternions(robot, on_host(to_jax(q, robot.q0.dtype)))
    return q if isinstance(q, Tracer) else _without_roundings(robot, q)


def _is_integer(home: Any) -> bool:
    return isinstance(home, int | np.integer) and not isinstance(home, bool)


def _as_array(home: Any, dtype: Any) -> Array:
    try:
        return to_jax(home, dtype)
    except (TypeError, ValueError):
        raise OsikTypeError(
            f"home is {home!r}; it is a configuration (nq,), a mapping from joint names to values, or the name or "
            "number of a keyframe"
        ) from None


def _keyframe(robot: RobotModel, home: Any) -> np.ndarray:
    """Return the configuration of a keyframe, joints brought inside their limits; warn of those that were outside."""
    names = keyframe_names(robot.mj_model)
    if home not in (names if isinstance(home, str) else range(len(names))):
        raise unknown_name("keyframe", home, tuple(names))
    number = names.index(home) if isinstance(home, str) else int(home)
    q = robot.mj_model.key_qpos[number][robot.tree.own_qpos]
    if isinstance(robot.position_lower, Tracer):
        return q
    ranges = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    notes = list(home_notes(robot.tree, names[number], q, *ranges))
    if notes:
        warn(first_of([str(note) for note in notes]))
    return inside(robot.tree, q, *ranges)


def _with_joints(robot: RobotModel, values: Mapping[str, Any]) -> Numbers:
    """Return ``q0`` with named joints set: a number each, or all entries of a free (7) or ball joint (4)."""
    q = robot.q0
    for name, value in values.items():
        width, entries = QPOS_WIDTH[robot.tree.joint_types[robot.tree.joint(name)]], _as_array(value, q.dtype)
        if width == 1:
            q = with_joints(robot, {name: entries}, q)
            continue
        start = robot.joint_qpos_index(name)
        if entries.shape != (width,):
            layout = "x, y, z, then the quaternion w, x, y, z" if width == 7 else "a quaternion w, x, y, z"
            raise OsikValueError(f"home of joint {name!r} has shape {entries.shape}, expected ({width},): {layout}")
        q = replaced_at(q, slice(start, start + width), entries)
    return q


def _with_unit_quaternions(robot: RobotModel, q: Float[Numbers, " nq"]) -> Float[Numbers, " nq"]:
    for start in robot.tree.quaternions:
        part = slice(start, start + 4)
        q = replaced_at(q, part, q[part] / module_of(q).linalg.norm(q[part]))
    return q


def _without_roundings(robot: RobotModel, q: np.ndarray) -> Float[Array, " nq"]:
    """Return the configuration with roundoff beyond ranges removed; warn of joints farther outside."""
    if isinstance(robot.position_lower, Tracer):
        return to_jax(q)
    ranges = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    kept, out = inside(robot.tree, q, *ranges), joints_outside(robot.tree, q, *ranges, _OUTSIDE)
    for joint in out:
        part = slice(start := robot.tree.qpos_address[joint], start + QPOS_WIDTH[robot.tree.joint_types[joint]])
        kept[part] = q[part]
    if out:
        warn(
            f"home is outside the joints' ranges (radians, metres): {'; '.join(out.values())}. It is kept as given; "
            "the robot returns from there at the return_speed of ConfigurationLimit"
        )
    return to_jax(kept)
