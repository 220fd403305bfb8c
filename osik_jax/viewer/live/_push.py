"""Velocity disturbance that fades."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_FADES = 0.15
"""Time in which a push falls to 1/e [s]."""
_OVER = 1e-4
"""Push below which it ends [m/s or rad/s]."""


class Push:
    """Fading velocity added to that of the controller."""

    def __init__(self, still: Float[np.ndarray, "*batch nv"], dt: float) -> None:
        """Take velocities of 0 (nv,) and the period [s]."""
        self._share, self._velocity = float(np.exp(-dt / _FADES)), still.copy()
        self._none = jnp.asarray(still)

    def start(self, velocity: Float[np.ndarray, "*batch nv"]) -> None:
        """Start a push."""
        self._velocity = np.asarray(velocity, float).copy()

    def stop(self) -> None:
        """End the push."""
        self._velocity[:] = 0.0

    def now(self) -> Float[Array, "*batch nv"]:
        """Return the velocity of this step [m/s or rad/s], and reduce it for the next. (nv,)."""
        if not self._velocity.any():
            return self._none
        pushed = jnp.asarray(self._velocity, self._none.dtype)
        self._velocity *= self._share
        if np.abs(self._velocity).max() < _OVER:
            self.stop()
        return pushed
