"""Ranges of ball joints as bounds on the next step.

A ball joint is turned by an angle about an axis; its range bounds the angle. Along the axis the angle grows by what the
joint turns. A turn across the axis makes the angle grow too, in the second order: by at most
``step^2 / (2 (range - step))``, for the angle is twice a distance on the unit sphere in four dimensions, whose second
derivative is the cotangent of the distance. So a bound along the axis alone would be left by a step across it. Steps
near the end of the range are therefore short, and the bound along the axis has a margin that such a step cannot use up.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics._guarded import rate_of_way
from ..robot import Robot
from ..robot._joint_selection import dofs_of
from ..robot._ranges import ball_rotation, independent_balls
from ._box import Time

MARGIN = 0.002
"""Share of the range that is kept clear of its end."""
SHORTEST = 0.06
"""Share of the range that a step may always turn by; its square is less than ``2 MARGIN (1 - MARGIN - SHORTEST)``."""
_RETURN = 0.5
"""Share of the longest step by which a joint comes back from outside its range: the bounds on the step allow it."""


class BallRates(NamedTuple):
    """Bounds on the angular velocity of each independent ball joint, which follow from those on its next step."""

    dofs: list[list[int]]  # entries of v of each joint. (k, 3)
    axis: Float[Array, "k 3"]  # about which each joint is turned, in its body; 0 where ``outward`` does not bind
    outward: Float[Array, " k"]  # greatest rate along the axis [rad/s], inf for none
    fastest: Float[Array, " k"]  # greatest absolute value of each entry [rad/s], inf for none


def ball_rates(
    robot: Robot,
    q: Float[Array, " nq"],
    upper: Float[Array, " nv"],
    gain: Float[Array, " nv"],
    return_speed: Float[Array, " nv"],
    dt: Time,
    *,
    margin: float,
    shortest: float,
) -> BallRates | None:
    """Return the bounds on a step of dt of the ball joints; None without ball joints.

    Farther from the end of the range than ``shortest``, a rotation shorter than the distance to the end cannot leave
    the range. Nearer to it, ``shortest`` bounds the rotation, and a row bounds its part about the axis. ``upper`` has
    the greatest angles [rad] in the three entries of each ball joint, ``gain`` the share of the way to the end that a
    step may take. Half of ``return_speed`` [rad/s] is used outside the range: each entry of the box allows that.
    ``margin`` is the share of the range that is kept clear of its end, ``shortest`` the share that a step may always
    turn by; inf for any length.
    """
    joints = independent_balls(robot.tree)
    if not joints:
        return None
    dofs = [dofs_of(robot, [joint]) for joint in joints]
    first = jnp.array([own[0] for own in dofs])
    turned = [ball_rotation(q[at : at + 4]) for at in (robot.tree.qpos_address[joint] for joint in joints)]
    angle, axis = (jnp.stack(part) for part in zip(*turned, strict=True))
    free, share = upper[first] >= jnp.pi, gain[first]  # no rotation is greater than pi
    span = jnp.where(free, jnp.pi, upper[first])
    way, least = span - angle, (shortest if np.isfinite(shortest) else 1.0) * span
    # a box of this half-width has no vector longer than the allowed step
    longest = jnp.maximum(share * way, least) / jnp.sqrt(3.0)
    speed = return_speed[first]
    unlimited = jnp.isinf(speed)  # inf dt has no derivative
    swift = jnp.where(unlimited, longest, jnp.where(unlimited, 1.0, speed) * dt)
    back = -_RETURN * jnp.minimum(longest, swift)
    outward = jnp.maximum(share * (way - margin * span), back)
    binds = ~free & (way < 0.5 * span)  # the axis of a small angle is ill-conditioned, and the length is bound enough
    return BallRates(
        dofs,
        jnp.where(binds[:, None], axis, 0.0),
        jnp.where(binds, rate_of_way(outward, dt), jnp.inf),
        jnp.where(free | jnp.isinf(shortest), jnp.inf, rate_of_way(longest, dt)),
    )
