"""Joint ranges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._arguments import check_bounds, concrete
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_values, scalar_layout
from ._box import Kind, Limit

_ROUNDOFF = 8.0  # machine epsilons of the way to a bound that are kept clear of it, so that q + v dt stays within


class ConfigurationLimit(Limit):
    """Keeps hinges and slides in their range: ``gain (lower - q) / dt <= v <= gain (upper - q) / dt``.

    A step of dt with a velocity in this box ends inside the range to the last bit, rounding included. Ball and free
    joints have no range. With a gain below 1 a joint approaches the end of its range step by step, and one found
    outside comes back in the same way: each step at least that share of the distance.

    Args:
        robot: the robot; its ``position_lower`` and ``position_upper`` are the defaults.
        lower: lower limits [rad or m]: an array (nv,), or a mapping from joint names or globs to values that replaces
            the robot's own for those joints. -inf: free.
        upper: upper limits, in the same way.
        gain: the share of the way to a limit that a step may take, above 0 and up to 1: a scalar, an array (nv,), or a
            mapping from joint names or globs to values, the others having 1. mink's default is 0.95, pink's 0.5.

    Raises:
        KeyError: a mapping names a joint that does not exist.
        ValueError: a wrong shape, lower > upper, a finite limit on a ball or free joint, or a gain outside (0, 1].
    """

    kind: ClassVar[Kind] = "position"
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    gain: Float[Array, ""] | Float[Array, " nv"]

    def __init__(
        self,
        robot: Robot,
        *,
        lower: ArrayLike | Array | Mapping[str, float] | None = None,
        upper: ArrayLike | Array | Mapping[str, float] | None = None,
        gain: ArrayLike | Array | Mapping[str, float] = 1.0,
    ):
        self.lower = dof_values(robot, lower, robot.position_lower, "lower")
        self.upper = dof_values(robot, upper, robot.position_upper, "upper")
        low, high = concrete(self.lower), concrete(self.upper)
        if low is not None and high is not None:
            _check(robot, low, high)
        self.gain = _as_gain(robot, gain)

    def box(
        self, robot: Robot, q: Float[Array, " nq"], dt: Float[Array, ""] | float
    ) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
        """Velocities that lead to the ends of each range in one step of dt [s]."""
        scalar, index = scalar_layout(robot)
        position = jnp.asarray(q)[index]
        lower = self._reach(jnp.where(scalar, self.lower, -jnp.inf), position, dt, inward=1.0)
        upper = self._reach(jnp.where(scalar, self.upper, jnp.inf), position, dt, inward=-1.0)
        return jnp.minimum(lower, upper), upper

    def _reach(
        self, bound: Float[Array, " nv"], position: Float[Array, " nv"], dt: Float[Array, ""] | float, *, inward: float
    ) -> Float[Array, " nv"]:
        """Velocity that leads towards the bound, rounded inward; an infinite bound stays so, with gradients 0."""
        free = jnp.isinf(bound)
        way = jnp.where(free, 0.0, bound) - position
        way = way + inward * _ROUNDOFF * jnp.finfo(way.dtype).eps * jnp.abs(way)
        return jnp.where(free, bound, self.gain * way / dt)

    def _convert(self, name: str, value: Any) -> Any:
        if name == "gain" and np.shape(value) == self.lower.shape:
            return jnp.asarray(value, self.gain.dtype)
        return super()._convert(name, value)

    def _check(self) -> None:
        check_bounds(self.lower, self.upper)
        _check_gain(self.gain)


def _as_gain(robot: Robot, value: ArrayLike | Array | Mapping[str, float]) -> Float[Array, ""] | Float[Array, " nv"]:
    """One for all joints as a scalar, others over v."""
    if isinstance(value, Mapping) or np.ndim(value):
        gain = dof_values(robot, value, jnp.ones(robot.nv), "gain")
    else:
        gain = jnp.asarray(value, robot.q0.dtype)
    _check_gain(gain)
    return gain


def _check_gain(gain: Array) -> None:
    seen = concrete(gain)
    if seen is not None and not ((seen > 0.0) & (seen <= 1.0)).all():
        raise OsikValueError(f"gain is {seen}; it is the share of the way that a step may take, above 0 and up to 1")


def _check(robot: Robot, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raises ValueError with the joints' names."""
    names = dof_names(robot)
    unordered = np.flatnonzero(~(lower <= upper))
    if len(unordered):
        what = ", ".join(f"{names[i]} ({lower[i]} > {upper[i]})" for i in unordered)
        raise OsikValueError(f"limits with lower > upper: {what}")
    scalar, _ = scalar_layout(robot)
    bounded = np.flatnonzero(~scalar & (np.isfinite(lower) | np.isfinite(upper)))
    if len(bounded):
        what = ", ".join(dict.fromkeys(names[i] for i in bounded))
        raise OsikValueError(f"only hinges and slides have a range; leave these infinite: {what}")
