"""Limits on joint speeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError
from ..numerics._arguments import concrete, entries
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_values
from ..robot._ranges import warn_of_fast_joints
from ._box import Kind, Limit


class VelocityLimit(Limit):
    """``-velocity <= v <= velocity``.

    Args:
        robot: the robot; its ``velocity_limit`` is the default.
        velocity: greatest speeds [rad/s or m/s]: an array (nv,), or a mapping from joint names or globs to values that
            replaces the robot's own for those joints. A free base takes part only when it is named (the value then
            bounds its three linear [m/s] and three angular [rad/s] velocities) or in an array. Infinite: free.

    Raises:
        KeyError: the mapping names a joint that does not exist.
        ValueError: a wrong shape, or a speed that is negative or not a number.

    Warns:
        OsikWarning: a speed is more than ten times the robot's own, as degrees a second are.
    """

    kind: ClassVar[Kind] = "velocity"
    velocity: Float[Array, " nv"]

    def __init__(self, robot: Robot, *, velocity: ArrayLike | Array | Mapping[str, float] | None = None):
        self.velocity = dof_values(robot, velocity, robot.velocity_limit, "velocity")
        self._check(dof_names(robot))
        if velocity is not None:
            warn_of_fast_joints(dof_names(robot), self.velocity, robot.velocity_limit, "velocity")

    def box(
        self, robot: Robot, q: Float[Array, " nq"], dt: Float[Array, ""] | float
    ) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
        """Return (-velocity, velocity)."""
        del robot, q, dt
        return -self.velocity, self.velocity

    def _check(self, names: Sequence[str] | None = None) -> None:
        seen = concrete(self.velocity)
        if seen is not None and not (seen >= 0.0).all():
            raise OsikValueError(f"velocity limits have to be 0 or more: {entries(seen, ~(seen >= 0.0), names)}")
