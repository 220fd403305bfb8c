"""Limits on joint accelerations, and on speeds from which a joint can still stop inside its range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._arguments import check_bounds, check_positive, concrete
from ..numerics._guarded import rate_of_way
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_values, scalar_layout
from ._box import Box, Kind, Limit, Time, limit_box
from ._configuration import ConfigurationLimit

_ROUNDOFF = 32.0  # machine epsilons of the way to a bound that braking leaves over
_MOST_STEPS = 1e6  # of braking


class AccelerationLimit(Limit):
    """Limit ``|v - v_last| <= acceleration dt``, and speeds from which a joint can stop inside its range.

    With the distance ``d`` to a bound, the greatest speed towards it is the one from which braking by
    ``acceleration dt`` in each step stops on the bound, in whole steps:

        v = d / (n dt) + (n - 1) / 2 acceleration dt,    n the least number with  n (n + 1) / 2 acceleration dt^2 >= d

    (n dt v minus the n (n - 1) / 2 acceleration dt^2 lost by braking is d). It is the discrete form of
    ``v^2 <= 2 acceleration d`` (A. Del Prete, "Joint position and velocity bounds in discrete-time
    acceleration/torque control of robot arms", RA-L 2018; F. Flacco, A. De Luca, O. Khatib, ICRA 2012), and exact where
    positions move by ``v dt``. From a state that fulfils it, every velocity in the box leads to another such state. So
    ranges, speeds and accelerations never contradict each other in closed loop.

    From other states (outside the range, too fast, stopped too late) the acceleration holds, then the velocity limit,
    then the speed from which the joint can stop at the other end. A joint outside its range returns at
    ``return_speed``, as soon as its acceleration allows it.

    It needs the velocity of the last step: ``rollout`` hands it on; around ``solve`` use
    ``limit = limit.after(solution.velocity)``.

    Args:
        robot: the robot; its ``position_lower`` and ``position_upper`` are the default ranges.
        acceleration: greatest accelerations [rad/s^2 or m/s^2]: an array (nv,), or a mapping from joint names or globs
            to values that replaces the robot's own ``acceleration_limit`` for those joints. Default: the robot's own,
            which a URDF 1.2 has. A free base takes part only when it is named (the value then bounds the change of each
            of its six velocities) or in an array. Infinite: free.
        velocity: of the last step, (nv,) [rad/s or m/s], or a mapping in the same way; default 0: at rest.
        lower: lower ends of the ranges, as in ``ConfigurationLimit``; use the same there. -inf: none.
        upper: upper ends of the ranges, in the same way.
        return_speed: speed at which a joint outside its range returns [rad/s or m/s], as in ``ConfigurationLimit``; use
            the same there.

    Raises:
        KeyError: a mapping names a joint that does not exist.
        ValueError: a wrong shape, an acceleration that is not positive, no acceleration for a robot that has none of
            its own, or a range or return speed as in ``ConfigurationLimit``.
    """

    kind: ClassVar[Kind] = "acceleration"
    bound_name: ClassVar[str] = "acceleration limit"
    acceleration: Float[Array, " nv"]
    velocity: Float[Array, " nv"]
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    return_speed: Float[Array, " nv"]

    def __init__(
        self,
        robot: Robot,
        acceleration: ArrayLike | Array | Mapping[str, float] | None = None,
        *,
        velocity: ArrayLike | Array | Mapping[str, float] | None = None,
        lower: ArrayLike | Array | Mapping[str, float] | None = None,
        upper: ArrayLike | Array | Mapping[str, float] | None = None,
        return_speed: ArrayLike | Array | Mapping[str, float] | None = None,
    ):
        own = concrete(robot.acceleration_limit)
        if acceleration is None and own is not None and np.isinf(own).all():
            raise OsikValueError(
                "the robot has no acceleration limits of its own: give acceleration, such as {'*': 10.0} in rad/s^2"
            )
        self.acceleration = dof_values(robot, acceleration, robot.acceleration_limit, "acceleration")
        self.velocity = dof_values(robot, velocity, np.zeros(robot.nv), "velocity")
        ranges = ConfigurationLimit(robot, lower=lower, upper=upper, return_speed=return_speed)
        self.lower, self.upper, self.return_speed = ranges.lower, ranges.upper, ranges.return_speed
        self._check(dof_names(robot))

    def parts(self) -> Sequence[Limit]:
        """Return acceleration and braking as separate limits, because velocity limits are applied between them."""
        stopping = _Stopping(self.acceleration, self.lower, self.upper, self.return_speed)
        return _Reachable(self.acceleration, self.velocity), stopping

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return the bounds of both parts together."""
        return limit_box(robot, q, self.parts(), dt)

    def _check(self, names: Sequence[str] | None = None) -> None:
        check_bounds(self.lower, self.upper)
        check_positive("return speeds", self.return_speed, names)
        check_positive("accelerations", self.acceleration, names)

    def after(self, velocity: Float[Array, " nv"]) -> Self:
        """Return the limit for the next step, given this step's ``velocity``."""
        return eqx.tree_at(lambda limit: limit.velocity, self, jnp.asarray(velocity, self.velocity.dtype))


class _Reachable(Limit):
    """Velocities reachable from the last velocity in one step."""

    kind: ClassVar[Kind] = "acceleration"
    acceleration: Float[Array, " nv"]
    velocity: Float[Array, " nv"]

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        del robot, q
        # infinite minus infinite would be NaN, also in derivatives
        free = jnp.isinf(self.acceleration)
        change = _rounded(jnp.where(free, 0.0, self.acceleration) * dt)
        lower, upper = self.velocity - change, self.velocity + change
        return jnp.where(free, -jnp.inf, lower), jnp.where(free, jnp.inf, upper)


class _Stopping(Limit):
    """Speeds from which joints can stop inside their ranges."""

    kind: ClassVar[Kind] = "braking"
    acceleration: Float[Array, " nv"]
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    return_speed: Float[Array, " nv"]

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return the bounds by braking.

        A joint outside its range returns at the return speed, or slower to stop at the other end.
        """
        scalar, index = scalar_layout(robot)
        position = jnp.asarray(q)[index]
        above = stopping_speed(_way(jnp.where(scalar, self.upper, jnp.inf), position), self.acceleration, dt)
        below = stopping_speed(_way(-jnp.where(scalar, self.lower, -jnp.inf), -position), self.acceleration, dt)
        # a joint beyond its range has a negative stopping speed: it returns, at most at the return speed
        lower, upper = -jnp.maximum(below, -self.return_speed), jnp.maximum(above, -self.return_speed)
        outside = upper < 0.0  # above the range; below it, the lower bound is the one to give way
        least, most = jnp.minimum(lower, upper), jnp.maximum(lower, upper)
        return jnp.where(outside, lower, least), jnp.where(outside, most, upper)


def _rounded(product: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Return the product rounded to one bit less, so that a compiler cannot fuse it with a following sum."""
    precision = jnp.finfo(product.dtype)
    return jax.lax.reduce_precision(product, precision.nexp, precision.nmant - 1)


def _way(bound: Float[Array, " nv"], position: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Return the distance to the bound, rounded down; an infinite bound stays infinite, with gradient 0."""
    free = jnp.isinf(bound)
    way = jnp.where(free, 0.0, bound) - position
    return jnp.where(free, bound, way - _ROUNDOFF * jnp.finfo(way.dtype).eps * jnp.abs(way))


def stopping_speed(way: Float[Array, " nv"], acceleration: Float[Array, " nv"], dt: Time) -> Float[Array, " nv"]:
    """Return the greatest velocity from which braking in whole steps stops within a distance.

    See ``AccelerationLimit``. The velocity is continuous and piecewise linear in ``way``, the distance [rad or m], with
    n braking steps in a piece. It is ``way / dt`` for a negative distance or an infinite acceleration.
    """
    free, instant = jnp.isinf(way), jnp.isinf(acceleration)
    way_left = jnp.where(free, 0.0, way)
    change = jnp.where(instant, 1.0, acceleration) * dt
    least = jnp.finfo(way_left.dtype).tiny
    # the number of braking steps is piecewise constant: it has no derivative
    triangle = jax.lax.stop_gradient(jnp.maximum(way_left, 0.0) / jnp.maximum(change * dt, least))
    # least n with n (n + 1) / 2 >= triangle, by the quadratic formula
    steps = jnp.ceil(0.5 * (jnp.sqrt(1.0 + 8.0 * triangle) - 1.0))
    # the upper end keeps the quotient finite for accelerations near 0
    steps = jnp.where(instant, 1.0, jnp.clip(steps, 1.0, _MOST_STEPS))
    speed = rate_of_way(way_left, steps * dt) + 0.5 * (steps - 1.0) * change
    return jnp.where(free, way, speed)
