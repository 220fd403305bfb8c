"""Conversion of a user's poses, one or many, to arrays."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._errors import OsikValueError
from ..execution._platform import on_host
from ..kinematics._pose_forms import as_pose, check_last_row, pose_array, pose_parts
from ..kinematics._rigid import rotation_matrix
from ..numerics._arguments import concrete
from ..numerics._host import Numbers
from ..numerics._rotations import exact_quaternion, exact_rotation
from ..robot import Robot
from ._chain_search import Goal

_POSITION = (True,) * 3 + (False,) * 3
_POSE = (True,) * 6
_ACCEPTED = (
    "a pose is (position (3,), rotation matrix (3, 3)), (position (3,), quaternion w x y z (4,)), a (4, 4) matrix, a "
    "jaxlie.SE3, or a position (3,) alone; many have one more axis in front"
)


def read_poses(robot: Robot, targets: Mapping[str, Any]) -> tuple[Goal, tuple[tuple[bool, ...], ...], int | None]:
    """Return goals (targets, frames, ...), which rows of each frame are used, and the number of targets.

    The number is None for one target that is no batch.

    Raises:
        TypeError, ValueError: something that is no pose, or batches of different lengths.
        KeyError: no such frame.
    """
    parts, (values, structure) = {}, jax.tree.flatten(list(targets.values()))
    traced = any(isinstance(leaf, Tracer) for leaf in values)
    if not traced and any(isinstance(leaf, jax.Array) for leaf in values):
        # all arrays at once, because each transfer from a GPU makes the host wait
        fetched = iter(jax.device_get([leaf for leaf in values if isinstance(leaf, jax.Array)]))
        values = [next(fetched) if isinstance(leaf, jax.Array) else leaf for leaf in values]
    # an operation of JAX's costs as much as a short search; it alone refuses all that is no number
    numbers = np if all(isinstance(leaf, np.ndarray) and leaf.dtype.kind in "fiu" for leaf in values) else jnp
    with nullcontext() if traced else on_host():
        for name, value in zip(targets, jax.tree.unflatten(structure, values), strict=True):
            try:
                parts[name] = _one(value, robot.q0.dtype, numbers)
            except (TypeError, ValueError) as error:
                raise type(error)(f"targets[{name!r}]: {error}") from None
    counts = {name: position.shape[0] for name, (position, _, _) in parts.items() if position.ndim == 2}
    if len(set(counts.values())) > 1:
        raise OsikValueError(
            f"the numbers of targets differ: {', '.join(f'{name}: {count}' for name, count in counts.items())}"
        )
    count = next(iter(counts.values()), None)
    if count == 0:
        raise OsikValueError("there are no targets: the poses have a leading axis of length 0")
    numbers = jnp if traced else np

    def together(part: int) -> Numbers:
        own = [one[part] for one in parts.values()]
        if count is None:
            return numbers.stack(own)[None]
        return numbers.stack([numbers.broadcast_to(a, (count, *a.shape[-1 - part :])) for a in own], 1)

    return Goal(cast(Array, together(0)), cast(Array, together(1))), tuple(rows for _, _, rows in parts.values()), count


def _one(value: Any, dtype: Any, numbers: Any) -> tuple[Numbers, Numbers, tuple[bool, ...]]:
    """Return position, rotation and rows of one pose or of n. (3,) or (n, 3), likewise the rotation."""
    pose = pose_parts(value, dtype, _ACCEPTED, numbers)
    two = isinstance(value, list) and pose is not None and pose[0].shape == pose[1].shape in ((3,), (4, 4))
    if pose is None or two:
        array = numbers.stack(pose) if two else pose_array(value, dtype, _ACCEPTED, numbers)
        if array.shape[-1:] == (3,) and array.ndim <= 2:
            _check_finite(array)
            return array, numbers.broadcast_to(numbers.eye(3, dtype=dtype), (*array.shape[:-1], 3, 3)), _POSITION
        if array.shape[-2:] != (4, 4) or array.ndim > 3:
            raise OsikValueError(f"got an array of shape {array.shape}; a pose is a (4, 4) matrix, a position is (3,)")
        check_last_row(array)
        pose = array[..., :3, 3], array[..., :3, :3]
    if pose[0].ndim == 1:
        return *as_pose(pose, dtype, numbers=numbers), _POSE
    if pose[0].shape[1:] != (3,) or pose[1].ndim not in (2, 3) or len(pose[0]) != len(pose[1]):
        raise OsikValueError(
            f"got positions of shape {pose[0].shape} and rotations of shape {pose[1].shape}; many poses are positions "
            "(n, 3) with rotation matrices (n, 3, 3) or quaternions w x y z (n, 4), or matrices (n, 4, 4)"
        )
    position, rotation = pose
    if rotation.shape[1:] not in ((4,), (3, 3)):
        raise OsikValueError(f"got rotations of shape {rotation.shape}; many are (n, 3, 3), or (n, 4): w x y z")
    _check_finite(position)
    if rotation.ndim == 2:
        return position, rotation_matrix(exact_quaternion(rotation, "rotation")), _POSE
    return position, exact_rotation(rotation, "rotation"), _POSE


def _check_finite(array: Array) -> None:
    seen = concrete(array)
    if seen is not None and not np.isfinite(seen).all():
        raise OsikValueError("the targets' positions have to be finite")
