"""Conversion of a user's numbers to a task's array leaves, with checks of concrete values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics._forward import home_kinematics as home_kinematics
from ..numerics._arguments import as_array as as_array
from ..numerics._arguments import as_bounds as as_bounds
from ..numerics._arguments import as_scalar as as_scalar
from ..numerics._arguments import as_vector as as_vector
from ..numerics._arguments import check_bounds as check_bounds
from ..numerics._arguments import check_finite as check_finite
from ..numerics._arguments import check_not_nan
from ..numerics._arguments import check_not_negative as check_not_negative
from ..numerics._arguments import concrete as concrete
from ..numerics._host import on_host, repeated
from ..robot import Robot
from ..robot._joint_selection import dof_values
from ..robot._size import robot_size

WeightLike = ArrayLike | Array | Mapping[str, float]
"""One weight, one per row, or weights by joint name."""


def as_own_weight(value: Any) -> Float[Array, "..."]:
    """Return a scalar or a vector of weights as an array; float arrays keep their precision, all else becomes float."""
    rows = np.shape(value)
    if len(rows) > 1:
        raise OsikValueError(f"weight has shape {rows}, expected a scalar or a vector. Batch with jax.vmap.")
    own = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
    return as_weight(value, rows[0] if rows else None, value.dtype if own else float)


def as_weight(value: Any, rows: int | None, dtype: Any, *, like: tuple[int, ...] = ()) -> Float[Array, "..."]:
    """Return a weight for all rows, or one per row; a scalar takes the shape ``like``.

    ``rows=None`` accepts a scalar only.
    """
    out = as_array(value, "weight", dtype)
    if out.shape not in ((), (rows,)):
        each = "" if rows is None else f", or ({rows},): one for each row"
        raise OsikValueError(f"weight has shape {out.shape}, expected a scalar{each}. Batch with jax.vmap.")
    check_not_nan(out, "weight")
    check_not_negative(out, "weight")
    return out if out.shape else repeated(out, like)


def joint_weight(robot: Robot, value: Any, dofs: list[int]) -> Any:
    """Return a weight of the rows of some dofs that is given by joint names or in the order of v; others unchanged."""
    if isinstance(value, Mapping) or (np.shape(value) == (robot.nv,) and len(dofs) != robot.nv):
        return on_host(dof_values(robot, value, np.zeros(robot.nv), "weight"))[np.array(dofs, int)]
    return value


_BACKGROUND = 1e-4
"""Default weight of a background task: small against the positions and, 100 times less so, orientations of a pose."""
_FULL_SIZE = 0.5
"""Robot size [m] from which joint angles have their full weight."""
_LEAST_SIZE = 0.016
"""Robot size [m] below which the weight stays constant, so that it stays above the schemes' damping."""


def background_weight(robot: Robot) -> Float[Array, ""] | float:
    """Return the default weight of background rows of joint angles: 1e-4 for robots of half a metre or more.

    A joint moves a frame by its angle times a lever arm, so squared angles outweigh squared distances on a small robot.
    Below half a metre the weight falls with the square of the robot's size (``robot_size``).
    """
    return _BACKGROUND * angle_scale(robot)


def angle_scale(robot: Robot) -> Float[Array, ""] | float:
    """Return the factor on weights of joint angles relative to distances: 1 for robots of half a metre or more."""
    size = robot_size(robot)
    if isinstance(size, float):
        # squared, because weights multiply squared errors
        return min(max(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE), 1.0) ** 2
    return jnp.clip(size / _FULL_SIZE, _LEAST_SIZE / _FULL_SIZE, 1.0) ** 2
