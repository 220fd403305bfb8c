"""Starts of searches: a sequence of points, each prefix of which fills a box evenly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from .._errors import OsikTypeError
from ..numerics._arguments import numbers_for

_BITS = 32
_UNLIMITED = 100.0
"""Limits further out than this [rad or m] are placeholders that files write for none, such as 1e9."""


def shift_of(key: int | Array, dimensions: int) -> UInt[Array, " n"]:
    """Return the shift of the sequence in each dimension, from an integer or a key of ``jax.random``."""
    try:
        made = jax.random.key(key) if jnp.issubdtype(jnp.result_type(key), jnp.integer) and jnp.ndim(key) == 0 else key
        return jax.random.bits(made, (dimensions,), jnp.uint32)
    except (TypeError, ValueError):
        raise OsikTypeError(f"key is {key!r}; it is an integer or a key of jax.random") from None


def starting_box(lower: Float[Array, " n"], upper: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the limits for starts: infinite beyond 100 rad or 100 m, where starts would be spread too thinly."""
    # starts spread over such a range would practically never be inside the robot's real one
    numbers = numbers_for(lower, upper)
    return numbers.where(lower < -_UNLIMITED, -np.inf, lower), numbers.where(upper > _UNLIMITED, np.inf, upper)


def unit_points(shift: UInt[Array, " n"], number: Int[Array, "..."], dtype: jnp.dtype) -> Float[Array, "... n"]:
    """Return the points of an additive recurrence in the unit cube (Kronecker's sequence).

    Its increments are the powers of 1/phi, phi being the positive root of ``phi**(n + 1) = phi + 1``: the golden ratio
    for n = 1. In integers that wrap around, so that a late point is as exact as the first.
    ``shift``: the start, as a fraction of the cube in units of 2**-32.
    """
    steps = jnp.asarray(increments(len(shift)))
    bits = shift + number.astype(jnp.uint32)[..., None] * steps
    return (bits >> 8).astype(dtype) * 2.0 ** (8 - _BITS)  # 24 bits: what single precision holds


def increments(dimensions: int) -> np.ndarray:
    """Return the increments of ``unit_points``, as fractions of the cube in units of 2**-32."""
    # any start above 1 converges to the fixed point
    phi = 1.5
    for _ in range(64):  # a contraction: phi = (1 + phi)^(1 / (n + 1))
        phi = (1.0 + phi) ** (1.0 / (dimensions + 1))
    fractions = phi ** -np.arange(1.0, dimensions + 1.0) % 1.0
    return np.floor(fractions * 2.0**_BITS).astype(np.uint64).astype(np.uint32)
