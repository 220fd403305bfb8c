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
from ..numerics._arguments import check_not_negative as check_not_negative
from ..numerics._arguments import concrete as concrete
from ..numerics._host import on_host, repeated
from ..robot import Robot
from ..robot._joint_selection import dof_values

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
    check_not_negative(out, "weight")
    return out if out.shape else repeated(out, like)


def as_joint_weight(robot: Robot, value: Any, dofs: list[int]) -> Float[Array, "..."]:
    """Return one weight per row of some dofs.

    It is given as a scalar, in the order of these rows, in the order of v, or by joint names.
    """
    dtype = robot.q0.dtype
    if isinstance(value, Mapping) or (np.shape(value) == (robot.nv,) and len(dofs) != robot.nv):
        value = on_host(dof_values(robot, value, np.zeros(robot.nv), "weight"))[np.array(dofs, int)]
    return as_weight(value, len(dofs), dtype)
