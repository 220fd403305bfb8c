"""Planes in contact with frames, and common parts of tasks on them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics._host import on_host, to_jax
from ._framed import FramedTask
from ._leaves import as_vector
from ._pointing import across, as_direction, unit


class PlaneTask(FramedTask):
    """Base of equality tasks that keep one frame on a plane of the world: all x with ``normal x = offset``."""

    frame: str = eqx.field(static=True)
    normal: Float[Array, "3"]
    offset: Float[Array, ""]

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the name of the frame."""
        return (self.frame,)

    @property
    def bounded(self) -> bool:
        """Return False: the rows are equalities."""
        return False

    def _convert(self, name: str, value: Any) -> Any:
        return as_normal(value, self.weight.dtype) if name == "normal" else super()._convert(name, value)


def as_normal(value: Any, dtype: Any) -> Float[Array, "3"]:
    """Return a unit normal from a vector of any non-zero length."""
    return to_jax(unit(on_host(as_direction(value, "normal", dtype))))


def as_offset(value: Any, dtype: Any) -> Float[Array, ""]:
    """Return the offset of a plane along its normal from the world's origin [m]."""
    return as_vector(value, (), "offset", dtype)


def plane_axes(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return right-handed axes as rows: two unit vectors in the plane, and the unit normal."""
    return jnp.concatenate([across(normal), normal[None]])
