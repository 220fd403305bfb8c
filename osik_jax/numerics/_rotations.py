"""Exact rotations from a user's rotations, which may be rounded to a few digits."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .._errors import OsikValueError
from ._arguments import concrete

ROUNDED = 0.02
"""Largest deviation from 1 of the length of a quaternion or a matrix column: numbers rounded to two or three digits."""
_EXACT = 64.0
"""Machine epsilons: a matrix whose residual is not greater is taken as it is."""
_ITERATIONS = 4
"""Number of Newton-Schulz iterations: each takes a residual e below e^2, so four take 0.04 below 1e-16."""


def _evaluated(function: Callable[[Array, str], Array]) -> Callable[[Array, str], Array]:
    """Decorate a function so that concrete arguments are evaluated during tracing and stay constants.

    Of NumPy's arrays it returns NumPy's.
    """

    @wraps(function)
    def evaluated(given: Array, what: str) -> Array:
        if isinstance(given, np.ndarray | Tracer):
            return function(given, what)
        with jax.ensure_compile_time_eval():
            return function(given, what)

    return evaluated


@_evaluated
def exact_quaternion(given: Float[Array, "*B 4"], what: str) -> Float[Array, "*B 4"]:
    """Return quaternions divided by their lengths, which must be 1 within 2 %.

    Raises:
        ValueError: a concrete length is not; the message calls the quaternion ``what``. A traced quaternion of another
            length becomes NaN.
    """
    quaternion, valid = _computed(_unit_quaternion, given)
    _refuse(valid, given, what, f"w x y z has to be of length 1 within {ROUNDED:.0%}")
    return quaternion


def _computed(function: Callable[[Array, Any], tuple[Array, Array]], given: Array) -> tuple[Array, Array]:
    """Return a function's results on the host, or by one program: on a GPU, single operations take milliseconds."""
    if isinstance(given, np.ndarray):
        return function(given, np)
    return jax.jit(function, static_argnums=1)(given, jnp)


def _unit_quaternion(given: Float[Array, "*B 4"], xp: Any) -> tuple[Float[Array, "*B 4"], Bool[Array, "*B"]]:
    squared = xp.sum(given**2, -1, keepdims=True)
    valid = (squared >= (1.0 - ROUNDED) ** 2) & (squared <= (1.0 + ROUNDED) ** 2)
    safe = xp.where(valid, given, xp.array([1.0, 0.0, 0.0, 0.0], given.dtype))
    length = xp.sqrt(xp.sum(safe**2, -1, keepdims=True))
    return xp.where(valid, safe / length, xp.nan), valid[..., 0]


@_evaluated
def exact_rotation(given: Float[Array, "*B 3 3"], what: str) -> Float[Array, "*B 3 3"]:
    """Return the rotation matrices nearest to the given ones, whose columns must have length 1 within 2 %.

    Raises:
        ValueError: a concrete matrix is not that close to a rotation; the message calls it ``what``. Such a matrix
            becomes NaN if it is traced.
    """
    rotation, valid = _computed(_nearest_rotation, given)
    _refuse(valid, given, what, f"R R' = I within {ROUNDED:.0%} of the lengths, det R = 1")
    return rotation


def _nearest_rotation(given: Float[Array, "*B 3 3"], xp: Any) -> tuple[Float[Array, "*B 3 3"], Bool[Array, "*B"]]:
    eye = xp.eye(3, dtype=given.dtype)
    off = _product(given, xp.swapaxes(given, -1, -2), xp) - eye
    residual = xp.max(xp.abs(off), (-1, -2), keepdims=True)
    first, second, third = (given[..., k, :] for k in range(3))
    right_handed = xp.sum(xp.cross(first, second) * third, -1)[..., None, None] > 0.0
    valid = (residual <= (1.0 + ROUNDED) ** 2 - 1.0) & right_handed
    exact = residual <= _EXACT * float(jnp.finfo(given.dtype).eps)
    safe = xp.where(valid, given, eye)
    if xp is np:
        rotation = safe if exact.all() else _nearest(safe, xp)
    else:
        rotation = jax.lax.cond(jnp.all(exact), lambda matrix: matrix, partial(_nearest, xp=xp), safe)
    return xp.where(valid, xp.where(exact, safe, rotation), xp.nan), valid[..., 0, 0]


def _nearest(matrix: Float[Array, "*B 3 3"], xp: Any) -> Float[Array, "*B 3 3"]:
    """Return the orthogonal factor of the polar decomposition (Higham, "Functions of Matrices", 2008, section 8.3)."""
    for _ in range(_ITERATIONS):
        gram = _product(xp.swapaxes(matrix, -1, -2), matrix, xp)
        matrix = 1.5 * matrix - 0.5 * _product(matrix, gram, xp)
    return matrix


def _product(a: Float[Array, "*B 3 3"], b: Float[Array, "*B 3 3"], xp: Any) -> Float[Array, "*B 3 3"]:
    return a @ b if xp is np else jnp.matmul(a, b, precision="highest")


def matrix_of(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a unit quaternion w x y z, with NumPy."""
    w, x, y, z = quaternion.tolist()
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.array(rows, quaternion.dtype)


def _refuse(valid: Bool[Array, "*B"], given: Array, what: str, right: str) -> None:
    """Raise ValueError with the first invalid concrete value and the indices of up to ten of them."""
    seen, values = concrete(valid), concrete(given)
    if seen is None or values is None or seen.all():
        return
    if seen.ndim == 0:
        raise OsikValueError(f"{what} is not one: {right}, got {values.tolist()}")
    at = np.argwhere(~seen)[:10].tolist()
    places = [place[0] if len(place) == 1 else tuple(place) for place in at]
    raise OsikValueError(f"{what}s that are none: {places}; {right}, the first is {values[tuple(at[0])].tolist()}")
