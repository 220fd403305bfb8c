"""Joint ranges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..numerics._arguments import check_bounds, check_positive, concrete
from ..numerics._constants import RANGE_ROUNDOFF
from ..numerics._guarded import rate_of_way
from ..numerics._host import Numbers, module_of, on_host, to_jax
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_values, dofs_of, scalar_layout
from ..robot._ranges import independent_balls
from ._ball import MARGIN, SHORTEST, BallRates, ball_rates
from ._box import Box, Kind, Limit, LimitRows, Time

_RETURN_SPEED_HINGE, _RETURN_SPEED_SLIDE = 0.5, 0.25
"""[rad/s] and [m/s]. ISO 10218-1 calls 0.25 m/s reduced speed; half a metre from a hinge, 0.5 rad/s is the same."""


class ConfigurationLimit(Limit):
    """Limit that keeps joints in their range: ``gain (lower - q) / dt <= v <= gain (upper - q) / dt``.

    A step of dt with a velocity in this box ends inside the range to the last bit, rounding included. With a gain below
    1 a joint approaches the end of its range step by step.

    A joint that is outside its range, as a measured one may be, returns at ``return_speed``; where less is left than a
    step at this speed, by the share ``gain`` of the rest in each step. Tasks may make it return faster.

    The range of a ball joint bounds the angle by which it is turned from its reference, MuJoCo's ``range``. ``upper``
    has that angle in the joint's three entries, and ``lower`` is not used there. The bound is a row along the axis of
    the turn, and a box: a joint comes to rest at 99.8 % of its range, and near the end turns by at most 3.4 % of the
    range a step about each of its axes, so that no step leaves the range. From outside it returns at half of
    ``return_speed``. Free joints have no range.

    Args:
        robot: the robot; its ``position_lower`` and ``position_upper`` are the defaults.
        lower: lower limits [rad or m]: an array (nv,), or a mapping from joint names or globs to values that replaces
            the robot's own for those joints. -inf: free.
        upper: upper limits, in the same way.
        gain: the share of the way to a limit that a step may take, above 0 and up to 1: a scalar, an array (nv,), or a
            mapping from joint names or globs to values, the others having 1. mink's default is 0.95, pink's 0.5.
        return_speed: speed at which a joint outside its range returns [rad/s or m/s], positive: an array (nv,), or a
            mapping from joint names or globs to values that replaces the default for those joints. Default: the
            robot's own ``velocity_limit`` of the joint, and where that is infinite, 0.5 rad/s or 0.25 m/s. Infinite:
            the joint returns in one step, as far as other limits allow it.

    Raises:
        KeyError: a mapping names a joint that does not exist.
        ValueError: a wrong shape, lower > upper, a finite limit on a free joint, a ball joint's angle that is not
            positive or differs between its entries, a gain outside (0, 1], or a return speed that is not positive.
    """

    kind: ClassVar[Kind] = "position"
    bound_name: ClassVar[str] = "limit"
    ball_margin: ClassVar[float] = MARGIN
    ball_step: ClassVar[float] = SHORTEST
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    gain: Float[Array, ""] | Float[Array, " nv"]
    return_speed: Float[Array, " nv"]

    def __init__(
        self,
        robot: Robot,
        *,
        lower: ArrayLike | Array | Mapping[str, float] | None = None,
        upper: ArrayLike | Array | Mapping[str, float] | None = None,
        gain: ArrayLike | Array | Mapping[str, float] = 1.0,
        return_speed: ArrayLike | Array | Mapping[str, float] | None = None,
    ):
        self.lower = dof_values(robot, lower, robot.position_lower, "lower")
        self.upper = dof_values(robot, upper, robot.position_upper, "upper")
        low, high = concrete(self.lower), concrete(self.upper)
        if low is not None and high is not None:
            _check(robot, low, high)
        self.gain = _as_gain(robot, gain)
        self.return_speed = dof_values(robot, return_speed, _own_return_speed(robot), "return_speed")
        check_positive("return speeds", self.return_speed, dof_names(robot))

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return the velocities that lead to the ends of each range in one step of dt [s], or back at return speed."""
        scalar, index = scalar_layout(robot)
        position = jnp.asarray(q)[index]
        lower = self._reach(jnp.where(scalar, self.lower, -jnp.inf), position, dt, inward=1.0)
        upper = self._reach(jnp.where(scalar, self.upper, jnp.inf), position, dt, inward=-1.0)
        lower, upper = jnp.minimum(lower, self.return_speed), jnp.maximum(upper, -self.return_speed)
        balls = self._balls(robot, q, dt)
        if balls is not None:
            fastest = jnp.full_like(upper, jnp.inf).at[jnp.array(balls.dofs)].set(balls.fastest[:, None])
            lower, upper = jnp.maximum(lower, -fastest), jnp.minimum(upper, fastest)
        return jnp.minimum(lower, upper), upper

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows | None:
        """Return bounds on the rate of each ball joint's angle; None for a robot without ball joints."""
        del kinematics
        balls = self._balls(robot, q, dt)
        if balls is None:
            return None
        count = len(balls.dofs)
        matrix = jnp.zeros((count, robot.nv), balls.axis.dtype)
        matrix = matrix.at[np.arange(count)[:, None], np.array(balls.dofs)].set(balls.axis)
        return LimitRows(matrix, jnp.full(count, -jnp.inf, matrix.dtype), balls.outward)

    def has_rows(self, robot: Robot) -> bool:
        """Return whether the robot has ball joints, or a class of one's own has rows."""
        return type(self).rows is not ConfigurationLimit.rows or bool(independent_balls(robot.tree))

    def core_leaves(self) -> list[Any]:
        """Return the leaves of the range."""
        return [1, self.lower, self.upper, self.gain, self.return_speed]

    def sought(self, robot: Robot) -> Limit:
        """Return the limit with a gain of 1 and return in one step."""
        del robot
        return self.replace(gain=jnp.ones_like(self.gain), return_speed=jnp.full_like(self.upper, jnp.inf))

    def _balls(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> BallRates | None:
        gain = jnp.broadcast_to(self.gain, self.upper.shape)
        q = jnp.asarray(q, jnp.result_type(jnp.asarray(q), self.upper))
        form = dict(margin=self.ball_margin, shortest=self.ball_step)
        return ball_rates(robot, q, self.upper, gain, self.return_speed, dt, **form)

    def _reach(
        self, bound: Float[Array, " nv"], position: Float[Array, " nv"], dt: Time, *, inward: float
    ) -> Float[Array, " nv"]:
        """Return the velocity to the bound, rounded inward; infinite bounds stay infinite, with gradients 0."""
        free = jnp.isinf(bound)
        way = jnp.where(free, 0.0, bound) - position
        way = way + inward * RANGE_ROUNDOFF * jnp.finfo(way.dtype).eps * jnp.abs(way)
        return jnp.where(free, bound, rate_of_way(self.gain * way, dt))

    def _convert(self, name: str, value: Any) -> Any:
        if name == "gain" and np.shape(value) == self.lower.shape:
            return to_jax(value, self.gain.dtype)
        return super()._convert(name, value)

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        _check_gain(self.gain)
        check_positive("return speeds", self.return_speed)


def _own_return_speed(robot: Robot) -> Float[Numbers, " nv"]:
    """Return the speed limit of each joint, and a default speed for the joints that have none."""
    default = np.where(robot.tree.turning, _RETURN_SPEED_HINGE, _RETURN_SPEED_SLIDE)
    speed = on_host(robot.velocity_limit)
    return module_of(speed).where(abs(speed) < np.inf, speed, default)


def _as_gain(robot: Robot, value: ArrayLike | Array | Mapping[str, float]) -> Float[Array, ""] | Float[Array, " nv"]:
    """Return a scalar for a gain shared by all joints, and an array over v for others."""
    if isinstance(value, Mapping) or np.ndim(value):
        gain = dof_values(robot, value, np.ones(robot.nv), "gain")
    else:
        gain = to_jax(value, robot.q0.dtype)
    _check_gain(gain)
    return gain


def _check_gain(gain: Array) -> None:
    seen = concrete(gain)
    if seen is not None and not ((seen > 0.0) & (seen <= 1.0)).all():
        raise OsikValueError(f"gain is {seen}; it is the share of the way that a step may take, above 0 and up to 1")


def _check(robot: Robot, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise ValueError for invalid ranges, with the joints' names."""
    names = dof_names(robot)
    unordered = np.flatnonzero(~(lower <= upper))
    if len(unordered):
        what = ", ".join(f"{names[i]} ({lower[i]} > {upper[i]})" for i in unordered)
        raise OsikValueError(f"limits with lower > upper: {what}")
    scalar, _ = scalar_layout(robot)
    balls = [dofs_of(robot, [joint]) for joint in independent_balls(robot.tree)]
    turning = np.isin(np.arange(robot.nv), balls)
    bounded = np.flatnonzero(~scalar & ~turning & (np.isfinite(lower) | np.isfinite(upper)))
    if len(bounded):
        what = ", ".join(dict.fromkeys(names[i] for i in bounded))
        raise OsikValueError(f"a free joint has no range; leave these infinite: {what}")
    for own in balls:
        if not upper[own[0]] > 0.0 or (upper[own] != upper[own[0]]).any():
            raise OsikValueError(
                f"upper of the ball joint {names[own[0]]!r} is {upper[own]}; it is one positive angle, in all three "
                "entries"
            )
