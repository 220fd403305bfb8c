"""Arithmetic with correct derivatives where bounds coincide or the squares of small numbers underflow."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._host import Numbers, module_of

_FASTEST = 1e12
"""[1/s]: no joint moves so fast; a derivative by dt, the rate over dt, would soon be infinite in single precision."""


@jax.custom_jvp
def quotient(a: Float[Array, "*#S"], b: Float[Array, "*#S"]) -> Float[Array, "*S"]:
    """Return a / b for a b that is not 0; its derivatives need no square of b.

    The derivative of ``a / b`` itself divides by b^2. In single precision that is 0 for a b of 1e-23, and the
    derivative NaN. Dividing both by a constant of b's size does not help: XLA turns ``(a / s) / (b / s)`` into
    ``(a s) / (s b)`` when it compiles.
    """
    return a / b


@quotient.defjvp
def _quotient_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (a, b), (da, db) = primals, tangents
    value = quotient(a, b)
    return value, (da - value * db) / b


def at_most_inverse(gain: Float[Array, ""], dt: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return the gain, at most 1 / dt; if they are equal, the derivative is that of the gain.

    In single precision the derivative of 1 / dt is infinite for a dt of 1e-20, and 0 times that is NaN. So it is not
    taken if the gain is the smaller one.
    """
    dt = jnp.asarray(dt, jnp.result_type(gain))
    is_capped = gain > 1.0 / jax.lax.stop_gradient(dt)
    return jnp.where(is_capped, 1.0 / jnp.where(is_capped, dt, 1.0), gain)


def approach(rate: Float[Array, ""], bound: Float[Array, " m"], value: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return ``rate (bound - value)``; an infinite bound stays infinite at any rate, with gradients of 0."""
    free = jnp.isinf(bound)
    return jnp.where(free, bound, rate * (jnp.where(free, 0.0, bound) - value))


def rate_of_way(way: Float[Array, "*S"], dt: Float[Array, "*#S"] | float) -> Float[Array, "*S"]:
    """Return way / dt; a rate above ``_FASTEST``, which bounds nothing, has the derivative 0, not an infinite one."""
    dt = jnp.asarray(dt, way.dtype)
    is_far = jnp.abs(way) > _FASTEST * dt
    far = jax.lax.stop_gradient(way / dt)
    return jnp.where(is_far, far, quotient(jnp.where(is_far, 0.0, way), jnp.where(is_far, 1.0, dt)))


def positive_root(a: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root of positive entries; 0 with derivative 0 for others, NaN included.

    XLA may compute an entry twice with different rounding: an entry that is 0 by cancellation is then positive for one
    of the two conditions alone. So the number under the root of other entries is below rounding, not 1.
    """
    positive = a > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, a, jnp.finfo(a.dtype).eps ** 2)), 0.0)


def safe_norm(vector: Float[Numbers, " m"]) -> Float[Numbers, ""]:
    """Return the Euclidean norm without overflow or underflow of squares; its gradient at 0 is 0."""
    size = largest(vector)
    xp, squared = module_of(vector), ((vector / size) ** 2).sum()
    positive = squared > 0.0
    return size * xp.where(positive, xp.sqrt(xp.where(positive, squared, 1.0)), 0.0)


def largest(vector: Float[Numbers, "..."]) -> Float[Numbers, ""]:
    """Return the largest absolute entry, 1 where all are 0; a constant for derivatives."""
    xp = module_of(vector)
    found = xp.max(abs(vector if xp is np else jax.lax.stop_gradient(vector)), initial=0.0)
    return xp.where((found > 0.0) & (found < jnp.inf), found, 1.0)


def greatest(vectors: Float[Array, "*S m"]) -> Float[Array, "*S"]:
    """Return the largest entry of each vector; its derivative is that of the first largest entry.

    The derivative of ``jnp.max`` divides by the number of entries that equal the maximum. If XLA computes the entries
    twice with different rounding, that number is 0.
    """
    return jnp.take_along_axis(vectors, jnp.argmax(vectors, -1, keepdims=True), -1)[..., 0]


def clipped(x: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return x clipped into [lower, upper]; if all three are equal, the derivative is that of the bounds.

    Between equal bounds the result does not depend on x, but ``jnp.clip`` gives x a quarter of the derivative there. If
    x equals one of two different bounds, the derivative is the mean of both sides.
    """
    pinned = (x == lower) & (lower == upper)
    low, high = (jnp.where(pinned, bound, 0.0) for bound in (lower, upper))
    return jnp.where(pinned, 0.5 * low + 0.5 * high, jnp.clip(x, lower, upper))
