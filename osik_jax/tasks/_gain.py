"""Gains: decay rates of task errors [1/s]."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._guarded import at_most_inverse, safe_norm
from ._leaves import as_scalar, concrete


class AdaptiveGain(eqx.Module):
    """Gain that grows as the error shrinks (Ramos, eq. 3).

    ``gain(e) = (maximum - minimum) exp(-decay ||e||) + minimum`` [1/s]: gentle far from the target, so that the first
    velocities stay small, and firm near it. The speed ``gain(s) s`` grows with the error s everywhere only if
    ``maximum <= (1 + exp(2)) minimum``, about 8.39 times; beyond that the task slows down before it speeds up.

    All three are traced, so they can be tuned by gradient; the gradient is finite at e = 0.

    Attributes:
        maximum: gain at zero error [1/s].
        minimum: gain far from the target [1/s].
        decay: how fast the gain falls with the norm of the error [1/m, 1/rad, or one over whatever mix e is].

    Raises:
        ValueError: a value is not finite, negative, or ``maximum < minimum``.
    """

    maximum: Float[Array, ""]
    minimum: Float[Array, ""]
    decay: Float[Array, ""]

    def __init__(self, maximum: ArrayLike | Array, minimum: ArrayLike | Array, decay: ArrayLike | Array):
        self.maximum = as_scalar(maximum, "maximum")
        self.minimum = as_scalar(minimum, "minimum")
        self.decay = as_scalar(decay, "decay")
        high, low = concrete(self.maximum), concrete(self.minimum)
        if high is not None and low is not None and high < low:
            raise OsikValueError(f"an AdaptiveGain needs maximum >= minimum, got maximum {high} and minimum {low}")

    def __call__(self, error: Float[Array, " m"]) -> Float[Array, ""]:
        """Return the gain [1/s] at an error."""
        return (self.maximum - self.minimum) * jnp.exp(-self.decay * safe_norm(error)) + self.minimum


class _CappedGain(AdaptiveGain):
    """Adaptive gain of at most ``1 / dt`` [1/s]."""

    dt: Float[Array, ""]

    def __init__(self, gain: AdaptiveGain, dt: Float[Array, ""]):
        self.maximum, self.minimum, self.decay, self.dt = gain.maximum, gain.minimum, gain.decay, dt

    def __call__(self, error: Float[Array, " m"]) -> Float[Array, ""]:
        return at_most_inverse(super().__call__(error), self.dt)


Gain = Float[Array, ""] | AdaptiveGain
"""Stored form of a task's gain: a constant [1/s] or an AdaptiveGain."""


def as_gain(value: Any, dtype: Any = None) -> Gain:
    """Return a gain as a constant [1/s] or an AdaptiveGain, in the given precision or, for ``None``, its own."""
    if isinstance(value, AdaptiveGain):
        if dtype is None:
            return value
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), value)
    return as_scalar(value, "gain", dtype)


def capped_gain(gain: Gain, dt: Float[Array, ""] | float) -> Gain:
    """Return the gain, limited to 1 / dt [1/s]: that gain removes all of an error in one step of dt [s]."""
    if isinstance(gain, AdaptiveGain):
        return _CappedGain(gain, jnp.asarray(dt, gain.maximum.dtype))
    return at_most_inverse(gain, dt)


def evaluate_gain(gain: Gain, error: Float[Array, " m"]) -> Float[Array, ""]:
    """Return the gain [1/s] at an error."""
    return gain(error) if isinstance(gain, AdaptiveGain) else gain
