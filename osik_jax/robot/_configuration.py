"""Configurations by joint names, and checks of configurations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Num

from .._errors import OsikTypeError, OsikValueError
from ..numerics._host import on_host, replaced_at, to_jax
from ._model import RobotModel
from ._tree import BALL, FREE, check_shape

_LEAST_QUATERNION = 1e-8
"""A quaternion that is not longer has no direction, so it counts as zero."""


def with_joints(robot: RobotModel, joints: Mapping[str, Any], base: Num[ArrayLike, " nq"] | None) -> Array:
    """Return ``q0`` (or ``base``) with the named joints set, unchecked."""
    q = on_host(robot.q0 if base is None else to_jax(base, robot.q0.dtype))
    offset, coefficient = on_host(robot.qpos_offset), robot.tree.qpos_source[1]
    for name, value in joints.items():
        joint = robot.tree.joint(name)
        if robot.tree.joint_types[joint] in (FREE, BALL):
            raise OsikValueError(
                f"joint {name!r} is free or ball: set its entries of q, from joint_qpos_index({name!r})"
            )
        if not isinstance(value, Tracer) and not _is_number(value):
            raise OsikTypeError(f"the value of joint {name!r} is {value!r}; it is one number, in radians or metres")
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
