"""Rows of limits that are not a box: bounds on linear functions of the velocity."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics._dense import apply


class LimitRows(eqx.Module):
    """Rows of a limit at one configuration, beside its box: ``lower <= jacobian @ v <= upper``, hard.

    Attributes:
        jacobian: of what is bounded. (m, nv)
        lower: of its rate, -inf for none. (m,)
        upper: of its rate, inf for none. (m,)
    """

    jacobian: Float[Array, "m nv"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]

    def violation(self, velocity: Float[Array, " nv"]) -> Float[Array, " m"]:
        """Return the distance of each row's value outside its bounds; 0 if the row holds. (m,)."""
        value = apply(self.jacobian, velocity)
        return jnp.maximum(jnp.maximum(self.lower - value, value - self.upper), 0.0)
