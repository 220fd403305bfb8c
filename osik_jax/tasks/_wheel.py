"""Task of a rolling wheel."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..execution._backends import Backend
from ..kinematics._rigid import cross
from ..robot import Robot
from ._curvature import pose_curvature
from ._gain import AdaptiveGain, as_gain
from ._leaves import as_vector, as_weight, check_not_negative
from ._plane import PlaneTask, as_normal, as_offset
from ._pointing import as_direction, unit
from ._rotation import dot
from ._task import DEFAULT_GAIN, Task, TaskRows, check_priority


class WheelTask(PlaneTask):
    """Task that makes a wheel roll on a plane of the world without slipping.

    With a the wheel's axis and n the plane's normal in world axes, the wheel rolls along ``x = a x n / |a x n|``, its
    side is ``y = n x x``, and it touches the plane at ``p + radius (a x x)``, its lowest point, also when it leans.
    With u the velocity of the wheel's material there and h its height over the plane:

    - ``x u = 0`` and ``y u = 0``: no slip ahead, none to the side. These are velocities that cannot be integrated to a
      configuration: their error is 0, and what the steps of a loop miss is not made up for later;
    - ``h' = -gain h``: the wheel stays on the plane.

    A wheel with rollers on its rim (omniwheel, mecanum) has one row in place of the first two: no slip along the
    roller's axis, ``(cos(angle) x + sin(angle) y) u = 0``. A wheel that lies flat on the plane has no rolling
    direction; there its centre is what is held at the plane.

    With a base that is free to move, wheels at priority 1 or with ``hard=True`` turn a wanted motion of the base, or of
    a hand, into turns of the wheels.

    Args:
        robot: the robot.
        frame: name of a body, link, site or geom that turns with the wheel, with its origin at the wheel's centre.
        radius: of the wheel [m].
        axis: about which it turns, in the frame's axes, of any length. A turn about it by the right-hand rule rolls
            the wheel ahead, along x.
        roller_angle: makes a wheel with rollers: from the rolling direction to the roller's axis on the plane, about n
            [rad]: 0 for an omniwheel, +-pi/4 for most mecanum wheels. Default: a plain wheel.
        normal: of the plane, in the world, towards the wheel, of any length.
        offset: of the plane along its normal [m].
        weight: of each squared row: a scalar, or one for each.
        gain: of the height [1/s], a number or an ``AdaptiveGain``.
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

    Raises:
        KeyError: no such frame.
        ValueError: a wrong shape, a direction of length 0, a negative radius or weight.
    """

    radius: Float[Array, ""]
    axis: Float[Array, "3"]
    roller_angle: Float[Array, ""] | None

    def __init__(
        self,
        robot: Robot,
        frame: str,
        *,
        radius: ArrayLike | Array,
        axis: ArrayLike | Array = (0.0, 1.0, 0.0),
        roller_angle: ArrayLike | Array | None = None,
        normal: ArrayLike | Array = (0.0, 0.0, 1.0),
        offset: ArrayLike | Array = 0.0,
        weight: ArrayLike | Array = 1.0,
        gain: ArrayLike | Array | AdaptiveGain = DEFAULT_GAIN,
        priority: int = 1,
        hard: bool = False,
    ):
        robot.tree.frame(frame)
        self.frame = frame
        self.priority, self.hard = check_priority(priority), hard
        dtype = robot.q0.dtype
        self.gain = as_gain(gain, dtype)
        self.radius = _as_radius(radius, dtype)
        self.axis = unit(as_direction(axis, "axis", dtype))
        self.roller_angle = None if roller_angle is None else as_vector(roller_angle, (), "roller_angle", dtype)
        self.normal, self.offset = as_normal(normal, dtype), as_offset(offset, dtype)
        self.weight = as_weight(weight, self._weight_rows, dtype)

    def rows_at(
        self,
        positions: Float[Array, "1 3"],
        rotations: Float[Array, "1 3 3"],
        jacobians: Float[Array, "1 6 nv"],
        backend: Backend = "jax",
    ) -> TaskRows:
        """Return the no-slip rows (ahead and sideways, or along the rollers), then the height row."""
        del backend
        axle = dot(rotations[0], self.axis)
        ahead = unit(cross(axle, self.normal))
        # axle x ahead points at the plane: for a level axle it is minus the normal
        spoke = self.radius * cross(axle, ahead)
        touching = jacobians[0, :3] + cross(jacobians[0, 3:], spoke[:, None], along=-2)
        directions = jnp.concatenate([self._rolling(ahead), self.normal[None]])
        height = dot(self.normal, positions[0] + spoke) - self.offset
        # slip is a velocity without an error to feed back; only the height has one
        error = jnp.zeros(len(directions), height.dtype).at[-1].set(height)
        weight = jnp.broadcast_to(self.weight, error.shape)
        moves = jnp.concatenate([touching, jacobians[0, 3:]])

        def bound(pull: Float[Array, " m"]) -> Float[Array, ""]:
            return pose_curvature(dot(pull, directions), jnp.zeros(3, pull.dtype), moves)

        return TaskRows.of(error, dot(directions, touching), gain=self.gain, weight=weight, curvature=bound)

    def sought(self, robot: Robot, q0: Float[Array, " nq"]) -> Task | None:
        """Return the task with its height alone: slipping is a matter of velocities."""
        height = jnp.asarray(np.eye(self._weight_rows)[-1], self.weight.dtype)
        return eqx.tree_at(lambda task: task.weight, super().sought(robot, q0), self.weight * height)

    @property
    def _weight_rows(self) -> int:
        return 3 if self.roller_angle is None else 2

    def _rolling(self, ahead: Float[Array, "3"]) -> Float[Array, "m 3"]:
        """Return the directions along the plane in which the wheel must not slip."""
        aside = cross(self.normal, ahead)
        if self.roller_angle is None:
            return jnp.stack([ahead, aside])
        return (jnp.cos(self.roller_angle) * ahead + jnp.sin(self.roller_angle) * aside)[None]

    def _convert(self, name: str, value: Any) -> Any:
        dtype = self.weight.dtype
        if name == "radius":
            return _as_radius(value, dtype)
        if name == "axis":
            return unit(as_direction(value, name, dtype))
        return super()._convert(name, value)


def _as_radius(value: Any, dtype: Any) -> Float[Array, ""]:
    out = as_vector(value, (), "radius", dtype)
    check_not_negative(out, "radius")
    return out
