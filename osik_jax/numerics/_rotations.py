"""Exact rotations from a user's rotations, which may be rounded to a few digits."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._errors import OsikValueError
from ._arguments import concrete

ROUNDED = 0.02
"""Largest deviation from 1 of the length of a quaternion or a matrix column: numbers rounded to two or three digits."""
_EXACT = 64.0
"""Machine epsilons: a matrix whose residual is not greater is taken as it is."""
_ITERATIONS = 4
"""Number of Newton-Schulz iterations: each takes a residual e below e^2, so four take 0.04 below 1e-16."""


def _evaluated(function: Callable[[Array], tuple[Array, Array]]) -> Callable[[Array], tuple[Array, Array]]:
    """Decorate a function so that concrete arguments are evaluated during tracing and stay constants."""

    @wraps(function)
    def evaluated(given: Array) -> tuple[Array, Array]:
        if concrete(given) is None:
            return function(given)
        with jax.ensure_compile_time_eval():
            return function(given)

    return evaluated


def exact_quaternion(given: Float[Array, "*B 4"], what: str) -> Float[Array, "*B 4"]:
    """Return quaternions divided by their lengths, which must be 1 within 2 %.

    Raises:
        ValueError: a concrete length is not; the message calls the quaternion ``what``. A traced quaternion of another
            length becomes NaN.
    """
    quaternion, valid = _unit_quaternion(given, np) if isinstance(given, np.ndarray) else _compiled_unit(given)
    _refuse(valid, given, what, f"w x y z has to be of length 1 within {ROUNDED:.0%}")
    return quaternion


def _unit_quaternion(given: Any, numbers: Any = jnp) -> tuple[Float[Array, "*B 4"], Bool[Array, "*B"]]:
    squared = numbers.sum(given**2, -1, keepdims=True)
    valid = (squared >= (1.0 - ROUNDED) ** 2) & (squared <= (1.0 + ROUNDED) ** 2)
    safe = numbers.where(valid, given, numbers.array([1.0, 0.0, 0.0, 0.0], given.dtype))
    length = numbers.sqrt(numbers.sum(safe**2, -1, keepdims=True))
    return numbers.where(valid, safe / length, numbers.nan), valid[..., 0]


# compiled as one program, like _nearest_rotation: on a GPU, operations run one by one take milliseconds
_compiled_unit = _evaluated(jax.jit(_unit_quaternion))


def exact_rotation(given: Float[Array, "*B 3 3"], what: str) -> Float[Array, "*B 3 3"]:
    """Return the rotation matrices nearest to the given ones, whose columns must have length 1 within 2 %.

    Raises:
        ValueError: a concrete matrix is not that close to a rotation; the message calls it ``what``. Such a matrix
            becomes NaN if it is traced.
    """
    if isinstance(given, np.ndarray) and _are_exact(given):
        return cast(Array, given)
    rotation, valid = _nearest_rotation(given)
    _refuse(valid, given, what, f"R R' = I within {ROUNDED:.0%} of the lengths, det R = 1")
    return rotation


def _are_exact(given: np.ndarray) -> bool:
    """Return whether all matrices are taken as they are."""
    residual = np.abs(given @ given.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
    return bool(residual <= _EXACT * float(np.finfo(given.dtype).eps) and (np.linalg.det(given) > 0.0).all())


@_evaluated
@jax.jit
def _nearest_rotation(given: Float[Array, "*B 3 3"]) -> tuple[Float[Array, "*B 3 3"], Bool[Array, "*B"]]:
    eye = jnp.eye(3, dtype=given.dtype)
    residual = jnp.max(jnp.abs(_product(given, jnp.swapaxes(given, -1, -2)) - eye), (-1, -2), keepdims=True)
    first, second, third = (given[..., k, :] for k in range(3))
    right_handed = jnp.sum(jnp.cross(first, second) * third, -1)[..., None, None] > 0.0
    valid = (residual <= (1.0 + ROUNDED) ** 2 - 1.0) & right_handed
    exact = residual <= _EXACT * float(jnp.finfo(given.dtype).eps)
    safe = jnp.where(valid, given, eye)
    rotation = jax.lax.cond(jnp.all(exact), lambda matrix: matrix, _nearest, safe)
    return jnp.where(valid, jnp.where(exact, safe, rotation), jnp.nan), valid[..., 0, 0]


def _nearest(matrix: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3 3"]:
    """Return the orthogonal factor of the polar decomposition (Higham, "Functions of Matrices", 2008, section 8.3)."""
    for _ in range(_ITERATIONS):
        gram = _product(jnp.swapaxes(matrix, -1, -2), matrix)
        matrix = 1.5 * matrix - 0.5 * _product(matrix, gram)
    return matrix


def _product(a: Float[Array, "*B 3 3"], b: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3 3"]:
    return jnp.matmul(a, b, precision="highest")


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
