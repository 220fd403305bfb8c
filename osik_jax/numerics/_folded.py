"""Reductions of short arrays, each one operation of a program for CPUs.

XLA splits a reduction of more than 32 numbers in a row into two operations, for the rounding of long sums. What has no
rounding is folded to rows of 32 before.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

_WIDTH = 32


def all_of(flags: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Whether all of them are set."""
    if jax.default_backend() != "cpu" or flags.size > _WIDTH**2:
        return flags.all()
    return jnp.pad(jnp.ravel(flags), (0, -flags.size % _WIDTH), constant_values=True).reshape(-1, _WIDTH).all()
