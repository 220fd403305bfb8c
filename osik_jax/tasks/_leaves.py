"""From the numbers that a user gives to the array leaves of a task, checked where they can be looked at."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from .._home import home_kinematics as home_kinematics
from .._joint_selection import as_array as as_array
from .._joint_selection import concrete as concrete
from .._numbers import as_bounds as as_bounds
from .._numbers import as_scalar as as_scalar
from .._numbers import as_vector as as_vector
from .._numbers import check_bounds as check_bounds
from .._numbers import check_finite as check_finite
from .._numbers import check_not_negative as check_not_negative

Pose = tuple[Float[Array, "3"], Float[Array, "3 3"]]
"""Position [m] and rotation (frame axes to world axes)."""

_ROTATION_TOLERANCE = 1e-4


def as_pose(value: Any, dtype: Any) -> Pose:
    """A pose from ``(position, rotation matrix)`` or a 4 x 4 matrix.

    Raises:
        ValueError: neither, or the rotation is not one.
    """
    if isinstance(value, (tuple, list)) and len(value) == 2:
        position, rotation = (as_array(part, "target", dtype) for part in value)
    else:
        matrix = as_array(value, "target", dtype)
        if matrix.shape != (4, 4):
            raise ValueError(f"a pose is (position (3,), rotation (3, 3)) or a (4, 4) matrix, got shape {matrix.shape}")
        position, rotation = matrix[:3, 3], matrix[:3, :3]
    if position.shape != (3,) or rotation.shape != (3, 3):
        raise ValueError(
            f"a pose is (position (3,), rotation (3, 3)), got shapes {position.shape} and {rotation.shape}. "
            "Batch with jax.vmap."
        )
    check_finite(position, "the target's position")
    _check_rotation(rotation)
    return position, rotation


def _check_rotation(rotation: Array) -> None:
    seen = concrete(rotation)
    if seen is None:
        return
    residual = np.abs(seen @ seen.T - np.eye(3)).max()
    if not (residual < _ROTATION_TOLERANCE and np.linalg.det(seen) > 0.0):
        raise ValueError(f"the target's rotation is not one (R R' = I to {_ROTATION_TOLERANCE}, det R = 1):\n{seen}")
