"""Bounds that cross at the start of a solver; at its end, an answer inside its box to the last bit."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._rules import custom_jvp


def uncrossed(
    lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, ""]]:
    """Crossed bounds as an equality halfway, which is as near to both as can be, and whether there were any."""
    crossed = lower > upper
    middle = 0.5 * jnp.where(crossed, lower + upper, 0.0)
    return jnp.where(crossed, middle, lower), jnp.where(crossed, middle, upper), crossed.any()


@custom_jvp
def inside(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """Takes rounding away; what is clipped keeps its own rate.

    The derivative of a clip is half that of x and half that of the bound where x touches it, and the bound's alone
    where rounding has carried x over: rates that belong to neither side of a change of the active set.
    """
    return clip_to_box(x, lower, upper)


@inside.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    return inside(*primals), tangents[0]


def clip_to_box(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """x in [lower, upper]; a bound that is none (NaN, an infinity on the wrong side) is passed over."""
    return jnp.clip(x, jnp.where(lower < jnp.inf, lower, -jnp.inf), jnp.where(upper > -jnp.inf, upper, jnp.inf))


def outside(values: Float[Array, " m"], lower: Float[Array, " m"], upper: Float[Array, " m"]) -> Float[Array, " m"]:
    """Values minus the nearest points of their intervals, exactly 0 inside."""
    return jnp.where(values < lower, values - lower, jnp.where(values > upper, values - upper, 0.0))
