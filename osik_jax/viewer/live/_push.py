"""A shove that fades."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_FADES = 0.15
"""Time in which it falls by 1/e [s]."""
_OVER = 1e-4
"""A push that is weaker is none [m/s or rad/s]."""


class Push:
    """A velocity beside that of the controller."""

    def __init__(self, still: Float[np.ndarray, "*batch nv"], dt: float) -> None:
        """Takes velocities of 0 and the period [s]."""
        self._share, self._velocity = float(np.exp(-dt / _FADES)), still.copy()
        self._none = jnp.asarray(still)

    def start(self, velocity: Float[np.ndarray, "*batch nv"]) -> None:
        """Pushes from now on."""
        self._velocity = np.asarray(velocity, float).copy()

    def stop(self) -> None:
        """Pushes no longer."""
        self._velocity[:] = 0.0

    def now(self) -> Float[Array, "*batch nv"]:
        """The velocity in this step; the next one's is weaker."""
        if not self._velocity.any():
            return self._none
        pushed = jnp.asarray(self._velocity, self._none.dtype)
        self._velocity *= self._share
        if np.abs(self._velocity).max() < _OVER:
            self.stop()
        return pushed
