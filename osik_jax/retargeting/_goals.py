"""What the robot is asked for in each frame, and how much each wish weighs."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def _number(value: Any) -> Array:
    """A number, or several, in the precision that is on."""
    return jnp.asarray(value, float)


class Goals(eqx.Module):
    """What one frame asks for; of a clip, every leaf has a leading axis of frames.

    Attributes:
        directions: of each of ``LIMBS``, unit vectors. (8, 3)
        pelvis: axes of the pelvis as columns. (3, 3)
        torso: axes of the chest as columns. (3, 3)
        root: midpoint of the hips [m]. (3,)
        feet: axes of the left and right foot as columns. (2, 3, 3)
        contact: 1 where left heel, left toe, right heel and right toe stand, more where they do so for long, 0
            elsewhere. (4,)
        present: 1 for a frame of the clip, 0 for padding behind its end. ()
    """

    directions: Float[Array, "*B 8 3"]
    pelvis: Float[Array, "*B 3 3"]
    torso: Float[Array, "*B 3 3"]
    root: Float[Array, "*B 3"]
    feet: Float[Array, "*B 2 3 3"]
    contact: Float[Array, "*B 4"]
    present: Float[Array, "*B"]


class Weights(eqx.Module):
    """Weights of squared residuals, and how far hard things are kept from their bounds.

    Attributes:
        limb: of the error of a limb's direction [1/rad^2].
        pelvis: of the pelvis' turn [1/rad^2].
        torso: of the chest's turn [1/rad^2].
        root: of the midpoint of the hips, along x, y and z [1/m^2]. (3,)
        foot: of the direction of a foot [1/rad^2].
        posture: of the joints' distance from home [1/rad^2].
        smooth: of a joint's change of step from one frame to the next [1/rad^2].
        smooth_base: the same of the base's position [1/m^2] and turn [1/rad^2].
        stance: of what a standing point moves, and of its height [1/m^2]; two thousandths of it, of what is nearer to
            the floor than 3 mm and does not stand.
        apart: of the depth of shapes that are nearer than ``margin`` [1/m^2].
        balance: of what the centre of mass is beyond its bound, where one is asked for [1/m^2].
        limit: of what joints are beyond their ranges [1/rad^2].
        speed: of what speeds and accelerations are beyond their limits, as shares of those [1].
        margin: least distance of shapes [m].
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
        """With accelerations of all dofs weighing ``time**4`` [s^4] more, beside 1 for the direction of a limb.

        Of one dof by itself, whose path x is to be followed, the minimum of ``(y - x)^2 + time^4 y''^2`` is x through a
        filter without delay that halves what has an angular frequency of ``1 / time``.

        Args:
            time: [s]
            dt: from one frame to the next [s].
        """
        more = (time / dt) ** 4
        return dataclasses.replace(self, smooth=self.smooth + more, smooth_base=self.smooth_base + more)
