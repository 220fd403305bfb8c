"""Rows of equality tasks by the compiled core: its results are the same for a pose and for a centre of mass."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics._kernels import Call
from ._task import TaskRows

Fields = tuple[Array, Array, Array, Array, Array, Array, Array, Array]


def fields_of(rows: TaskRows) -> Fields:
    """Return the arguments of ``equality_rows`` that give these rows; ``lower`` is used for both bounds."""
    fields = rows.error, rows.jacobian, rows.lower, rows.weight, rows.curvature, rows.pull, rows.levers
    return *fields, rows.squared_lengths()


def fields_by_core(
    call: Call, method: str, nv: int, weight: Float[Array, "lanes m"], *given: Array | np.ndarray
) -> Fields:
    """Return the arguments of ``equality_rows`` for a batch: arrays with an axis of lanes, or of length 1, in front."""
    count, lanes = weight.shape[1], max(len(a) for a in given if jnp.issubdtype(a.dtype, jnp.floating))
    shapes = (lanes, count), (lanes, count, nv), (lanes, count), (lanes,), (lanes, count), (lanes, nv), (lanes, count)
    error, rows, wanted, *rest = call(method, [(shape, float) for shape in shapes], *given)
    curvature, pull, levers, squares = rest
    return error, rows, wanted, jnp.broadcast_to(weight, error.shape), curvature, pull, levers, squares


def equality_rows(
    error: Array,
    jacobian: Array,
    wanted: Array,
    weight: Array,
    curvature: Array,
    pull: Array,
    levers: Array,
    squares: Array,
) -> TaskRows:
    """Return the rows of an equality from their fields, as the compiled core computes them."""
    fields = error, jacobian, wanted, wanted, weight, curvature, pull, levers
    return TaskRows(*fields, is_equality=True, squares=squares)
