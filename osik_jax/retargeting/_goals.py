"""Goals of each frame, and the weights of all terms."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def _number(value: Any) -> Array:
    """Return a number or array in JAX's default float precision."""
    return jnp.asarray(value, float)


class Goals(eqx.Module):
    """Goals of one frame; for a clip every leaf has a leading axis of frames."""

    # unit vectors along each of the limbs that are followed; of a reach, the vector over its nominal length
    directions: Float[Array, "*B limbs 3"]
    pelvis: Float[Array, "*B 3 3"]  # axes of the pelvis as columns
    torso: Float[Array, "*B 3 3"]  # axes of the chest as columns
    root: Float[Array, "*B 3"]  # midpoint of the hips, or the pelvis of a robot without legs [m]
    feet: Float[Array, "*B 2 3 3"]  # axes of the left and right foot as columns
    # for each point of ``Profile.standing``: 1 in contact, more in a long contact, else 0
    contact: Float[Array, "*B 4"]
    held: Float[Array, "*B reaches"]  # weight of each reach relative to ``limb``: 1; of what a joint holds more, or 0
    present: Float[Array, "*B"]  # 1 for a frame of the clip, 0 for padding behind its end


class Weights(eqx.Module):
    """Weights of squared residuals, and the least distance between shapes.

    Attributes:
        limb: limb directions [1/rad^2].
        pelvis: orientation of the pelvis [1/rad^2].
        torso: orientation of the chest [1/rad^2].
        root: midpoint of the hips along x, y and z [1/m^2]. (3,)
        foot: orientation of a foot [1/rad^2].
        posture: distance of the joints from home [1/rad^2].
        smooth: second difference of a joint's position over frames [1/rad^2].
        smooth_base: the same for the base's position [1/m^2] and orientation [1/rad^2].
        stance: motion and height of contact points [1/m^2]. 0.2 % of it applies to other sole points and shapes that
            are lower than 3 mm above the floor.
        apart: depth by which shapes are closer than ``margin`` [1/m^2].
        balance: distance of the centre of mass beyond its bound, if ``balance`` is used [1/m^2].
        limit: excess of joints beyond their ranges [1/rad^2].
        speed: excess of speeds and accelerations relative to their limits [1].
        margin: least distance between shapes [m].
    """

    limb: Float[Array, ""] = eqx.field(default=1.0, converter=_number)
    pelvis: Float[Array, ""] = eqx.field(default=0.3, converter=_number)
    torso: Float[Array, ""] = eqx.field(default=0.1, converter=_number)
    root: Float[Array, "3"] = eqx.field(default=(1.0, 1.0, 1.0), converter=_number)
    foot: Float[Array, ""] = eqx.field(default=0.05, converter=_number)
    posture: Float[Array, ""] = eqx.field(default=1e-3, converter=_number)
    smooth: Float[Array, ""] = eqx.field(default=0.02, converter=_number)
    smooth_base: Float[Array, ""] = eqx.field(default=0.02, converter=_number)
    stance: Float[Array, ""] = eqx.field(default=1e6, converter=_number)
    apart: Float[Array, ""] = eqx.field(default=1e4, converter=_number)
    balance: Float[Array, ""] = eqx.field(default=1e5, converter=_number)
    limit: Float[Array, ""] = eqx.field(default=1e3, converter=_number)
    speed: Float[Array, ""] = eqx.field(default=100.0, converter=_number)
    margin: Float[Array, ""] = eqx.field(default=0.005, converter=_number)

    def smoother(self, time: Float[Array, ""] | float, dt: Float[Array, ""] | float) -> Weights:
        """Return the weights with ``time**4`` [s^4] added to the weights of accelerations, relative to 1 for limbs.

        For one dof with target path x, the minimum of ``(y - x)^2 + time^4 y''^2`` is x after a zero-phase low-pass
        filter with gain 1/2 at the angular frequency ``1 / time``.

        Args:
            time: time constant of the smoothing [s].
            dt: time between frames [s].
        """
        more = (time / dt) ** 4
        return dataclasses.replace(self, smooth=self.smooth + more, smooth_base=self.smooth_base + more)
