"""Joint ranges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._joint_selection import concrete, dof_names, dof_values, scalar_layout
from ..robot import Robot
from ._box import Kind, Limit

_ROUNDING = 8.0  # machine epsilons of the way to a bound that are kept clear of it, so that q + v dt stays within


class ConfigurationLimit(Limit):
    """Keeps hinges and slides in their range: ``(lower - q) / dt <= v <= (upper - q) / dt``.

    A step of dt with a velocity in this box ends inside the range to the last bit, rounding included. Ball and free
    joints have no range.

    Args:
        robot: the robot; its ``position_lower`` and ``position_upper`` are the defaults.
        lower: lower limits [rad or m]: an array (nv,), or a mapping from joint names or globs to values that replaces
            the robot's own for those joints. -inf: free.
        upper: upper limits, in the same way.

    Raises:
        KeyError: a mapping names a joint that does not exist.
        ValueError: a wrong shape, lower > upper, or a finite limit on a ball or free joint.
    """

    kind: ClassVar[Kind] = "position"
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]

    def __init__(
        self,
        robot: Robot,
        *,
        lower: ArrayLike | Array | Mapping[str, float] | None = None,
        upper: ArrayLike | Array | Mapping[str, float] | None = None,
    ):
        self.lower = dof_values(robot, lower, robot.position_lower, "lower")
        self.upper = dof_values(robot, upper, robot.position_upper, "upper")
        low, high = concrete(self.lower), concrete(self.upper)
        if low is not None and high is not None:
            _check(robot, low, high)

    def box(
        self, robot: Robot, q: Float[Array, " nq"], dt: Float[Array, ""] | float
    ) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
        """Velocities that lead to the ends of each range in one step of dt [s]."""
        scalar, index = scalar_layout(robot)
        position = jnp.asarray(q)[index]
        lower = _reach(jnp.where(scalar, self.lower, -jnp.inf), position, dt, inward=1.0)
        upper = _reach(jnp.where(scalar, self.upper, jnp.inf), position, dt, inward=-1.0)
        return jnp.minimum(lower, upper), upper


def _reach(
    bound: Float[Array, " nv"], position: Float[Array, " nv"], dt: Float[Array, ""] | float, *, inward: float
) -> Float[Array, " nv"]:
    """Velocity that leads to the bound, rounded inward; an infinite bound stays so, with gradients 0."""
    free = jnp.isinf(bound)
    way = jnp.where(free, 0.0, bound) - position
    way = way + inward * _ROUNDING * jnp.finfo(way.dtype).eps * jnp.abs(way)
    return jnp.where(free, bound, way / dt)


def _check(robot: Robot, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raises ValueError with the joints' names."""
    names = dof_names(robot)
    crossed = np.flatnonzero(~(lower <= upper))
    if len(crossed):
        what = ", ".join(f"{names[i]} ({lower[i]} > {upper[i]})" for i in crossed)
        raise ValueError(f"limits with lower > upper: {what}")
    scalar, _ = scalar_layout(robot)
    bounded = np.flatnonzero(~scalar & (np.isfinite(lower) | np.isfinite(upper)))
    if len(bounded):
        what = ", ".join(dict.fromkeys(names[i] for i in bounded))
        raise ValueError(f"only hinges and slides have a range; leave these infinite: {what}")
