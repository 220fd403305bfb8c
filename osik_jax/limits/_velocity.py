"""Limits on the speeds of joints and of a floating base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikValueError, unknown_name
from ..kinematics import Kinematics
from ..numerics._arguments import as_vector, check_positive, concrete
from ..robot import Robot
from ..robot._joint_selection import dof_names, dof_values
from ..robot._ranges import warn_of_fast_joints
from ..robot._tree import FREE
from ._box import Box, Kind, Limit, LimitRows, Time


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
    bound_name: ClassVar[str] = "speed limit"
    velocity: Float[Array, " nv"]

    def __init__(self, robot: Robot, *, velocity: ArrayLike | Array | Mapping[str, float] | None = None):
        self.velocity = dof_values(robot, velocity, robot.velocity_limit, "velocity")
        self._check(dof_names(robot))
        if velocity is not None:
            warn_of_fast_joints(dof_names(robot), self.velocity, robot.velocity_limit, "velocity")

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return (-velocity, velocity)."""
        del robot, q, dt
        return -self.velocity, self.velocity

    def core_leaves(self) -> list[Any]:
        """Return the speeds, for each of the four leaves."""
        return [0, *[self.velocity] * 4]

    def _check(self, names: Sequence[str] | None = None) -> None:
        check_positive("velocity limits", self.velocity, names, or_zero=True)


class FloatingBaseVelocityLimit(Limit):
    """``-linear <= p' <= linear`` and ``-angular <= w <= angular``, along the base's own axes or the world's.

    p' is the velocity of the base's origin, w its angular velocity, both given in the chosen axes. A free joint's
    velocity in v is linear in world axes, then angular in those of the body: what is bounded in the same axes is part
    of the box, the other three are rows with the base's rotation in them.

    Args:
        robot: the robot.
        linear: greatest speeds along the three axes [m/s], (3,) or a scalar; left out or infinite: free.
        angular: greatest speeds about the three axes [rad/s], in the same way.
        axes: ``"base"`` or ``"world"`` (static).
        joint: name of the free joint; default: the robot's own, loose bodies of a scene left out (static).

    Raises:
        KeyError: no such free joint.
        ValueError: a wrong shape, a speed that is negative or not a number, no speed at all, an unknown option, or
            several free joints and none named.
    """

    kind: ClassVar[Kind] = "velocity"
    linear: Float[Array, "3"] | None
    angular: Float[Array, "3"] | None
    axes: str = eqx.field(static=True)
    joint: int = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        *,
        linear: ArrayLike | Array | None = None,
        angular: ArrayLike | Array | None = None,
        axes: Literal["base", "world"] = "base",
        joint: str | None = None,
    ):
        if linear is None and angular is None:
            raise OsikValueError("a FloatingBaseVelocityLimit needs linear, angular or both")
        if axes not in ("base", "world"):
            raise OsikValueError(f"axes is {axes!r}; it is 'base' or 'world'")
        self.axes, self.joint = axes, _free_joint(robot, joint)
        self.linear, self.angular = _speeds(robot, linear, "linear"), _speeds(robot, angular, "angular")

    def box(self, robot: Robot, q: Float[Array, " nq"], dt: Time) -> Box:
        """Return the bounds along the axes of v."""
        lower, upper = super().box(robot, q, dt)
        first = robot.tree.dof_address[self.joint]
        speeds, start = (self.linear, first) if self.axes == "world" else (self.angular, first + 3)
        if speeds is None:
            return lower, upper
        return lower.at[start : start + 3].set(-speeds), upper.at[start : start + 3].set(speeds)

    def has_rows(self, robot: Robot) -> bool:
        """Return whether speeds are bounded along axes that v does not have, or a class of one's own has rows."""
        del robot
        speeds = self.linear if self.axes == "base" else self.angular
        return speeds is not None or type(self).rows is not FloatingBaseVelocityLimit.rows

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"], dt: Time) -> LimitRows | None:
        """Return three rows along the axes that v does not have; None without such speeds.

        With R the base's rotation, they are ``R' p'`` in the base's axes or ``R w`` in the world's.
        """
        del q, dt
        speeds = self.linear if self.axes == "base" else self.angular
        if speeds is None:
            return None
        body = robot.tree.body_names[robot.tree.joint_bodies[self.joint]]
        _, rotation = kinematics.frame_pose(robot, body)
        turn = rotation.T if self.axes == "base" else rotation
        start = robot.tree.dof_address[self.joint] + (0 if self.axes == "base" else 3)
        jacobian = jnp.zeros((3, robot.nv), turn.dtype).at[:, start : start + 3].set(turn)
        return LimitRows(jacobian, -speeds, speeds)

    def _check(self) -> None:
        for what in self.replaceable:
            _check_speeds(getattr(self, what), what)


def _free_joint(robot: Robot, name: str | None) -> int:
    """Return the index of the free joint of that name, or of the only one."""
    tree = robot.tree
    free = {tree.joint_names[j]: j for j in tree.independent if tree.joint_types[j] == FREE}
    if not free:
        raise OsikValueError("the robot has no free joint; load it with floating_base=True, or use a VelocityLimit")
    if name is not None:
        if name not in free:
            raise unknown_name("free joint", name, tuple(free))
        return free[name]
    own = tree.free_bases
    if len(own) != 1:
        raise OsikValueError(f"which free joint? joint is one of: {', '.join(free)}")
    return own[0]


def _speeds(robot: Robot, value: ArrayLike | Array | None, what: str) -> Float[Array, "3"] | None:
    if value is None:
        return None
    speeds = as_vector(value, (3,), what, robot.q0.dtype)
    _check_speeds(speeds, what)
    return speeds


def _check_speeds(speeds: Float[Array, "3"], what: str) -> None:
    seen = concrete(speeds)
    if seen is not None and not np.all(seen >= 0.0):
        raise OsikValueError(f"{what} is {seen}; speeds have to be 0 or more")
