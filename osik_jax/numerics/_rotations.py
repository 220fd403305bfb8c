"""Exact rotations from a user's rotations, which may be rounded to a few digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from .._errors import OsikValueError
from ._host import Numbers, module_of, to_jax

ROUNDED = 0.02
"""Largest deviation from 1 of the length of a quaternion or a matrix column: numbers rounded to two or three digits."""
_EXACT = 64.0
"""Machine epsilons: a matrix whose residual is not greater is taken as it is."""
_ITERATIONS = 4
"""Number of Newton-Schulz iterations: each takes a residual e below e^2, so four take 0.04 below 1e-16."""


_Result = tuple[Numbers, Bool[Numbers, "*B"]]


def _exact(function: Callable[[Any], _Result], given: Numbers, what: str, right: str) -> Numbers:
    """Return the first result; concrete arguments are computed on the host and stay concrete while a program is traced.

    Where the second result is false, a concrete argument is refused, and a traced one becomes NaN.
    """
    if isinstance(given, Tracer):
        return jax.jit(function)(given)[0]
    with np.errstate(all="ignore"):
        out, valid = function(np.asarray(given))
    _refuse(valid, given, what, right)
    if isinstance(given, np.ndarray):
        return out
    with jax.ensure_compile_time_eval():
        return to_jax(out)


def exact_quaternion(given: Float[Numbers, "*B 4"], what: str) -> Float[Numbers, "*B 4"]:
    """Return quaternions divided by their lengths, which must be 1 within 2 %, as an array of the same kind."""
    return _exact(_unit_quaternion, given, what, f"w x y z has to be of length 1 within {ROUNDED:.0%}")


def _unit_quaternion(given: Float[Numbers, "*B 4"]) -> tuple[Float[Numbers, "*B 4"], Bool[Numbers, "*B"]]:
    xp = module_of(given)
    squared = (given**2).sum(-1, keepdims=True)
    valid = (squared >= (1.0 - ROUNDED) ** 2) & (squared <= (1.0 + ROUNDED) ** 2)
    safe = xp.where(valid, given, np.eye(1, 4, dtype=given.dtype)[0])
    length = xp.sqrt((safe**2).sum(-1, keepdims=True))
    return xp.where(valid, safe / length, np.nan), valid[..., 0]


def exact_rotation(given: Float[Numbers, "*B 3 3"], what: str) -> Float[Numbers, "*B 3 3"]:
    """Return the nearest rotations to matrices whose columns have length 1 within 2 %, as an array of the same kind."""
    return _exact(_nearest_rotation, given, what, f"R R' = I within {ROUNDED:.0%} of the lengths, det R = 1")


def _nearest_rotation(given: Float[Numbers, "*B 3 3"]) -> tuple[Float[Numbers, "*B 3 3"], Bool[Numbers, "*B"]]:
    xp = module_of(given)
    eye = np.eye(3, dtype=given.dtype)
    residual = abs(_product(given, given.swapaxes(-1, -2)) - eye).max((-1, -2), keepdims=True)
    right_handed = _determinant(given)[..., None, None] > 0.0
    valid = (residual <= (1.0 + ROUNDED) ** 2 - 1.0) & right_handed
    exact = residual <= _EXACT * float(jnp.finfo(given.dtype).eps)
    safe = xp.where(valid, given, eye)
    if xp is np:
        rotation = safe if exact.all() else _nearest(safe)
    else:
        rotation = jax.lax.cond(exact.all(), lambda matrix: matrix, _nearest, safe)
    return xp.where(valid, xp.where(exact, safe, rotation), np.nan), valid[..., 0, 0]


def _determinant(given: Float[Numbers, "*B 3 3"]) -> Float[Numbers, "*B"]:
    if module_of(given) is np:
        return np.linalg.det(given)
    first, second, third = (given[..., k, :] for k in range(3))
    return (jnp.cross(first, second) * third).sum(-1)


def _nearest(matrix: Float[Numbers, "*B 3 3"]) -> Float[Numbers, "*B 3 3"]:
    """Return the orthogonal factor of the polar decomposition (Higham, "Functions of Matrices", 2008, section 8.3)."""
    for _ in range(_ITERATIONS):
        gram = _product(matrix.swapaxes(-1, -2), matrix)
        matrix = 1.5 * matrix - 0.5 * _product(matrix, gram)
    return matrix


def _product(a: Float[Numbers, "*B 3 3"], b: Float[Numbers, "*B 3 3"]) -> Float[Numbers, "*B 3 3"]:
    return np.matmul(a, b) if module_of(a) is np else jnp.matmul(a, b, precision="highest")


def _refuse(valid: Any, given: Numbers, what: str, right: str) -> None:
    """Raise ValueError with the first invalid value and the indices of up to ten of them."""
    seen, values = np.asarray(valid), np.asarray(given)
    if seen.all():
        return
    if seen.ndim == 0:
        raise OsikValueError(f"{what} is not one: {right}, got {values.tolist()}")
    at = np.argwhere(~seen)[:10].tolist()
    places = [place[0] if len(place) == 1 else tuple(place) for place in at]
    raise OsikValueError(f"{what}s that are none: {places}; {right}, the first is {values[tuple(at[0])].tolist()}")
