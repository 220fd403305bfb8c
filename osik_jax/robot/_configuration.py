"""Configurations by joint names, checks of configurations, and home configurations from a user's input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikTypeError, OsikValueError, unknown_name, warn
from ..numerics._arguments import check_finite
from ..numerics._host import Numbers, module_of, on_host, replaced_at, to_jax
from ._model import RobotModel
from ._ranges import first_of, inside, joints_outside
from ._tree import BALL, FREE, QPOS_WIDTH, check_shape
from .loading._notes import home_notes, keyframe_names

Home: TypeAlias = str | int | Mapping[str, Any] | npt.ArrayLike | Array
"""A keyframe's name or number, a mapping from joint names to values, or a configuration (nq,)."""

_OUTSIDE = 1e-6
"""A value that is further out of its joint's range gets a warning [rad or m]; less is the rounding of a file."""
_LEAST_QUATERNION = 1e-8
"""A quaternion that is not longer has no direction, so it counts as zero."""


def with_joints(robot: RobotModel, joints: Mapping[str, Any], base: Num[ArrayLike, " nq"] | None) -> Array:
    """Return ``q0`` (or ``base``) with the named joints set, unchecked."""
    q = on_host(robot.q0 if base is None else to_jax(base, robot.q0.dtype))
    offset, coefficient = on_host(robot.qpos_offset), robot.tree.qpos_source[1]
    if not isinstance(joints, Mapping):
        raise OsikTypeError(f"joints is {joints!r}; it maps names of joints to values, in radians or metres")
    for name, value in joints.items():
        joint = robot.tree.joint(name)
        if robot.tree.joint_types[joint] in (FREE, BALL):
            raise OsikValueError(
                f"joint {name!r} is free or ball: set its entries of q, from joint_qpos_index({name!r})"
            )
        if not isinstance(value, Tracer) and not _is_number(value):
            raise OsikTypeError(f"the value of joint {name!r} is {value!r}; it is one number, in radians or metres")
        check_finite(value, f"the value of joint {name!r}")
        full, value = robot.tree.full_qpos_address[joint], on_host(value)
        index = robot.joint_qpos_index(name)
        q = replaced_at(q, index, (value - offset[full]) / coefficient[full])
    return to_jax(q)


def _is_number(value: Any) -> bool:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of unequal lengths
        return False
    return array.ndim == 0 and array.dtype.kind in "iuf"


def check_configuration(robot: RobotModel, q: Num[ArrayLike, " nq"] | Sequence[float], name: str) -> None:
    """Raise an error for an invalid q, see ``Robot.check_configuration``."""
    tree = robot.tree
    check_shape(tree, q, name)
    if isinstance(q, Tracer):
        return
    values = np.asarray(q)
    if not np.isfinite(values).all():
        raise OsikValueError(f"{name} is not finite at indices {np.flatnonzero(~np.isfinite(values)).tolist()}")
    for start in tree.quaternions:
        if np.linalg.norm(values[start : start + 4]) < _LEAST_QUATERNION:
            *_, joint = (tree.joint_names[j] for j, at in tree.qpos_address.items() if at <= start)
            raise OsikValueError(
                f"{name}[{start}:{start + 4}], the quaternion of joint {joint!r}, is zero; the identity is (1, 0, 0, 0)"
            )


def home_configuration(robot: RobotModel, home: Home) -> Float[Array, " nq"]:
    """Return a checked home configuration with unit quaternions; warn of joints outside their range."""
    if isinstance(home, str) or _is_integer(home):
        q: Any = _keyframe(robot, home)
    elif isinstance(home, Mapping):
        q = _with_entries(robot, home)
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


def _with_entries(robot: RobotModel, values: Mapping[str, Any]) -> Numbers:
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
