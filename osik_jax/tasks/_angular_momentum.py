"""A task on the angular momentum about the centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError
from ..kinematics import Kinematics, centroidal_momentum_matrix
from ..kinematics._forward import body_masses
from ..robot import Robot
from ._com import along_axes, axis_numbers, check_axes
from ._leaves import as_bounds, as_scalar, as_weight
from ._stay import MotionTask
from ._task import TaskRows, check_priority


class AngularMomentumTask(MotionTask):
    """Task on the robot's angular momentum about its centre of mass: at a value or within bounds.

    With A the angular rows of ``centroidal_momentum_matrix`` along the chosen axes of the world:

    - a target h*: ``A v = h*``; the default, 0, makes arms swing against legs;
    - bounds: ``lower <= A v <= upper``.

    A velocity is asked for, and no configuration: the error is 0, and there is no gain. Linear momentum is the
    mass times the velocity of a ``ComTask``.

    Args:
        robot: the robot.
        target: angular momentum [kg m^2/s], one entry for each axis, a vector x, y, z, or a scalar; default 0.
        lower: makes an inequality task: lower bounds [kg m^2/s], one for each axis, or a scalar.
        upper: upper bounds; one of the two may be left out, infinite entries bound nothing.
        axes: which of the world's axes, e.g. ``"xyz"``, ``"z"``.
        weight: of each squared row: a scalar, or one for each.
        priority: 1 is the most important.
        hard: makes it a constraint, see ``Task``.

    Raises:
        TypeError: a target and bounds.
        ValueError: a wrong shape, a negative weight, lower > upper, an unknown axis, or a robot without masses.
    """

    units: ClassVar[Mapping[str, str]] = {"": "kg m^2/s"}
    axes: str = eqx.field(static=True)
    target: Float[Array, " m"] | None
    lower: Float[Array, " m"] | None
    upper: Float[Array, " m"] | None

    def __init__(
        self,
        robot: Robot,
        *,
        target: ArrayLike | Array | None = None,
        lower: ArrayLike | Array | None = None,
        upper: ArrayLike | Array | None = None,
        axes: str = "xyz",
        weight: ArrayLike | Array = 1.0,
        priority: int = 1,
        hard: bool = False,
    ):
        if target is not None and (lower is not None or upper is not None):
            raise OsikTypeError("an AngularMomentumTask has a target or bounds (lower, upper), not both")
        self.axes = check_axes(axes)
        self.priority, self.hard = check_priority(priority), hard
        body_masses(robot)  # raises if there is no mass
        dtype = robot.q0.dtype
        self.weight = as_weight(weight, self._weight_rows, dtype)
        self.gain = as_scalar(0.0, "gain", dtype)
        self.lower, self.upper = as_bounds(lower, upper, len(axes), dtype)
        self.target = None
        if self.lower is None:
            self.target = along_axes(0.0 if target is None else target, axes, "target", dtype)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per axis [kg m^2/s]."""
        del q
        # the centroidal matrix has [linear; angular] rows
        kept = 3 + axis_numbers(self.axes)
        jacobian = centroidal_momentum_matrix(robot, kinematics)[kept]
        weight = jnp.broadcast_to(self.weight, (len(kept),))
        error = jnp.zeros(len(kept), jacobian.dtype)
        if self.lower is not None and self.upper is not None:
            return TaskRows(error, jacobian, self.lower, self.upper, weight, is_equality=False)
        # momentum depends on velocities alone, so the rows ask for the target as it is, without a gain
        wanted = error if self.target is None else self.target
        return TaskRows(error, jacobian, wanted, wanted, weight, is_equality=True)

    def error_bounds(self) -> tuple[Any, Any] | None:
        """Return None: the bounds are on the momentum, and the error is 0."""
        return None

    @property
    def _weight_rows(self) -> int:
        return len(self.axes)

    def _convert(self, name: str, value: Any) -> Any:
        if name == "target":
            return along_axes(value, self.axes, name, self.weight.dtype)
        return super()._convert(name, value)
