"""Intervals of variables and rows: contradictory bounds, clipping, violations and an exact line search."""

from __future__ import annotations

import jax
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


def minimum_along(
    value: Float[Array, " m"],
    rate: Float[Array, " m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    weight: Float[Array, " m"] | float,
    slope: Float[Array, ""],
    curvature: Float[Array, ""],
) -> Float[Array, ""]:
    """Return the step length t >= 0 at which a convex, piecewise quadratic cost is least (exact line search).

    The cost is ``1/2 sum weight dist(value + t rate, [lower, upper])^2 + slope t + 1/2 curvature t^2``. It has a knot
    where a row meets a bound.
    """
    moving = rate != 0.0
    safe_rate = jnp.where(moving, rate, 1.0)
    crossings = [
        jnp.where(moving & jnp.isfinite(b), (jnp.where(jnp.isfinite(b), b, 0.0) - value) / safe_rate, 1.0)
        for b in (lower, upper)
    ]
    knots = jnp.maximum(jnp.concatenate([*crossings, jnp.ones(1, value.dtype), jnp.zeros(1, value.dtype)]), 0.0)

    def derivative(t: Array) -> Array:
        return jnp.sum(weight * rate * violation(value + t * rate, lower, upper)) + slope + t * curvature

    derivatives = jax.vmap(derivative)(knots)
    before = jnp.max(jnp.where(derivatives < 0.0, knots, 0.0), initial=0.0)
    after = jnp.min(jnp.where(knots > before, knots, jnp.inf))  # the next knot, where the derivative is >= 0
    probe = jnp.where(jnp.isinf(after), before + 1.0, 0.5 * (before + after))
    # between two knots the derivative is a straight line, so the secant through two of its points has the root
    first, second = derivative(before), derivative(probe)
    rising = second > first
    root = before - first * (probe - before) / jnp.where(rising, second - first, 1.0)
    return jnp.where(rising, jnp.maximum(root, 0.0), before)
