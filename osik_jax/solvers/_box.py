"""Box constraints of a solver: contradictory bounds at its start, and clipping of its answer."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..execution._rules import custom_jvp
from ..numerics._guarded import clipped


def ordered_bounds(
    lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, ""]]:
    """Return bounds with each lower > upper replaced by their mean as an equality, and whether there were any."""
    unordered = lower > upper
    # 0 where bounds are in order: lower + upper may be inf - inf there, and its derivative NaN
    middle = 0.5 * jnp.where(unordered, lower + upper, 0.0)
    return jnp.where(unordered, middle, lower), jnp.where(unordered, middle, upper), unordered.any()


@custom_jvp
def clip_roundoff(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return x clipped into its box, with the derivative of the unclipped x.

    What is clipped here is roundoff. The derivative of a clip would be half that of x and half that of the bound where
    x touches it, and the bound's alone where roundoff has carried x over: neither is the derivative on a side of a
    change of the active set.
    """
    return clip_to_box(x, lower, upper)


@clip_roundoff.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    return clip_roundoff(*primals), tangents[0]


def clip_to_box(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return x clipped to [lower, upper]; invalid bounds (NaN, or infinite with the wrong sign) are ignored."""
    return clipped(x, jnp.where(lower < jnp.inf, lower, -jnp.inf), jnp.where(upper > -jnp.inf, upper, jnp.inf))


def violation(values: Float[Array, " m"], lower: Float[Array, " m"], upper: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return values minus the nearest points of their intervals: negative below, positive above, exactly 0 inside."""
    return jnp.where(values < lower, values - lower, jnp.where(values > upper, values - upper, 0.0))
