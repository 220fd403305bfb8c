"""Whole turns of hinges, which change no pose."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._arguments import numbers_for

TURN = 2.0 * np.pi


def unwound(
    x: Float[Array, "*lanes n"],
    about: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    turns: Sequence[bool],
) -> Float[Array, "*lanes n"]:
    """Add whole turns to coordinates within their limits, so that they are as near as possible to a configuration.

    ``turns``: of each coordinate, whether a whole turn changes no pose. Limits are -inf and inf where free [rad or m].
    """
    # the numbers of turns that stay inside the limits; infinite limits allow any number
    numbers = numbers_for(x, about, lower, upper)
    fewest, most = numbers.ceil((lower - x) / TURN), numbers.floor((upper - x) / TURN)
    number = numbers.clip(numbers.round((about - x) / TURN), fewest, most)
    moved = numbers.clip(x + TURN * number, lower, upper)
    return numbers.where(np.array(turns) & (number != 0.0), moved, x).astype(x.dtype)


def starting_range(
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    first: Float[Array, " n"],
    width: Float[np.ndarray, " n"],
    turns: Sequence[bool],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return finite ranges for the starts of searches: the limits, one turn, or ``width`` to both sides without limits.

    The last two are centred on the configuration ``first``, as far as the limits allow. Arguments as in ``unwound``.
    """
    free = jnp.isinf(lower) | jnp.isinf(upper)
    low = jnp.where(free, jnp.maximum(first - width, lower), lower)
    high = jnp.where(free, jnp.minimum(first + width, upper), upper)
    # beyond a whole turn, starts would repeat the same poses
    wide = np.array(turns) & (upper - lower > TURN)
    once = jnp.clip(first - 0.5 * TURN, lower, upper - TURN)
    return jnp.where(wide, once, low).astype(first.dtype), jnp.where(wide, once + TURN, high).astype(first.dtype)
