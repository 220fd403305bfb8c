"""From the numbers that a user gives to the array leaves of a task, checked where they can be looked at."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._joint_selection import concrete as concrete
from ..kinematics import Kinematics, forward_kinematics
from ..robot import Robot

Pose = tuple[Float[Array, "3"], Float[Array, "3 3"]]
"""Position [m] and rotation (frame axes to world axes)."""

_ROTATION_TOLERANCE = 1e-4


compiled_kinematics = jax.jit(forward_kinematics)
"""For work outside jit: compiled once for each tree."""


def home_kinematics(robot: Robot) -> Kinematics:
    """Where everything is at the robot's home configuration."""
    return compiled_kinematics(robot, robot.q0)


def as_scalar(value: Any, what: str, dtype: Any = None) -> Float[Array, ""]:
    """A finite number that is not negative: a gain, a weight. ``dtype=None``: an array's own, else JAX's default.

    Raises:
        ValueError: it is not, or not a scalar.
    """
    if dtype is None:
        own = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
        dtype = value.dtype if own else float
    out = as_vector(value, (), what, dtype)
    check_not_negative(out, what)
    return out


def as_vector(value: Any, shape: tuple[int, ...], what: str, dtype: Any) -> Array:
    """An array of this shape; a scalar is repeated.

    Raises:
        ValueError: any other shape.
    """
    out = jnp.asarray(value, dtype)
    if out.shape not in ((), shape):
        expected = "a scalar" if shape == () else f"{shape} or a scalar"
        raise ValueError(f"{what} has shape {out.shape}, expected {expected}. Batch with jax.vmap.")
    return jnp.broadcast_to(out, shape)


def check_not_negative(value: Array, what: str) -> None:
    """Raises ValueError where a value can be seen to be negative or not finite."""
    seen = concrete(value)
    if seen is not None and not (np.isfinite(seen).all() and (seen >= 0.0).all()):
        raise ValueError(f"{what} is {seen}; it has to be finite and not negative")


def as_bounds(lower: Any, upper: Any, rows: int, dtype: Any) -> tuple[Array | None, Array | None]:
    """Both bounds as arrays (rows,), a missing one infinite; (None, None) where neither is given."""
    if lower is None and upper is None:
        return None, None
    low = as_vector(-jnp.inf if lower is None else lower, (rows,), "lower", dtype)
    high = as_vector(jnp.inf if upper is None else upper, (rows,), "upper", dtype)
    check_bounds(low, high)
    return low, high


def check_bounds(lower: Array | None, upper: Array | None) -> None:
    """Raises ValueError where lower can be seen to be above upper."""
    low, high = concrete(lower), concrete(upper)
    if lower is None or upper is None or low is None or high is None:
        return
    if (low > high).any():
        rows = np.flatnonzero(low > high)
        raise ValueError(f"lower > upper in rows {rows.tolist()}: lower {low[rows]}, upper {high[rows]}")


def as_pose(value: Any, dtype: Any) -> Pose:
    """A pose from ``(position, rotation matrix)`` or a 4 x 4 matrix.

    Raises:
        ValueError: neither, or the rotation is not one.
    """
    if isinstance(value, (tuple, list)) and len(value) == 2:
        position, rotation = (jnp.asarray(part, dtype) for part in value)
    else:
        matrix = jnp.asarray(value, dtype)
        if matrix.shape != (4, 4):
            raise ValueError(f"a pose is (position (3,), rotation (3, 3)) or a (4, 4) matrix, got shape {matrix.shape}")
        position, rotation = matrix[:3, 3], matrix[:3, :3]
    if position.shape != (3,) or rotation.shape != (3, 3):
        raise ValueError(
            f"a pose is (position (3,), rotation (3, 3)), got shapes {position.shape} and {rotation.shape}. "
            "Batch with jax.vmap."
        )
    _check_rotation(rotation)
    return position, rotation


def _check_rotation(rotation: Array) -> None:
    seen = concrete(rotation)
    if seen is None:
        return
    residual = np.abs(seen @ seen.T - np.eye(3)).max()
    if not (residual < _ROTATION_TOLERANCE and np.linalg.det(seen) > 0.0):
        raise ValueError(f"the target's rotation is not one (R R' = I to {_ROTATION_TOLERANCE}, det R = 1):\n{seen}")
