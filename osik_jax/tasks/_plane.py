"""Planes that frames touch."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._leaves import as_vector
from ._pointing import across, as_direction, unit


def as_normal(value: Any, dtype: Any) -> Float[Array, "3"]:
    """A unit normal from a vector of any length but 0.

    Raises:
        ValueError: it is not such a vector.
    """
    return unit(as_direction(value, "normal", dtype))


def as_offset(value: Any, dtype: Any) -> Float[Array, ""]:
    """How far along its normal a plane lies from the world's origin [m].

    Raises:
        ValueError: not a scalar.
    """
    return as_vector(value, (), "offset", dtype)


def plane_axes(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rows: two unit vectors in the plane, and the unit normal; right-handed."""
    return jnp.concatenate([across(normal), normal[None]])
