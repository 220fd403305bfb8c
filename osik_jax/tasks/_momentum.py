"""Tasks on what the masses do: angular momentum and kinetic energy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import Kinematics, centroidal_momentum_matrix, mass_matrix
from ..kinematics._forward import body_masses
from ..numerics._constants import INERTIA_ROUNDOFF
from ..robot import Robot
from ._bases import MotionTask
from ._com import along_axes, axis_numbers, check_axes
from ._task import TaskRows


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
        self.axes, self.target = check_axes(axes), None
        body_masses(robot)  # raises if there is no mass
        dtype = self._set_up(robot, weight, priority, hard)
        if self._set_bounds(target, lower, upper, len(axes), dtype):
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


class KineticEnergyTask(MotionTask):
    """Task for low kinetic energy: among motions that serve other tasks, it prefers those that move little mass.

    With M = L L' the ``mass_matrix``, asks for ``L' v = 0``. In a weighted problem that adds ``weight v' M v / 2``,
    the weight times the kinetic energy [J]: damping in which a heavy dof counts more than a light one. It has as many
    rows as v has entries and leaves nothing free, so it comes last, or with a small weight. The error is 0, and
    there is no gain.

    L is a Cholesky factor. Where a motion moves no mass at all, M counts as larger by some roundings, so that L exists
    and has finite derivatives.

    Args:
        robot: the robot.
        weight: of the energy against the other tasks' squared rows, halved [1/J].
        hard: makes it a constraint, see ``Task``: nothing moves.

    Raises:
        ValueError: a negative weight, or a robot without masses.
    """

    def __init__(self, robot: Robot, *, weight: ArrayLike | Array = 1.0, priority: int = 1, hard: bool = False):
        body_masses(robot)  # raises if there is no mass
        self._set_up(robot, weight, priority, hard)

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return nv rows: the square root of the mass matrix."""
        del q
        root = _root(mass_matrix(robot, kinematics))
        # |U v|^2 = v' M v is twice the energy, and schemes halve squared rows: weight 1 counts the energy once
        zero = jnp.zeros(robot.nv, root.dtype)
        return TaskRows(zero, root, zero, zero, jnp.broadcast_to(self.weight, zero.shape), is_equality=True)


def _root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the upper triangular U with U' U = M, the joint-space inertia (positive semidefinite).

    The Cholesky factor is that of M with each dof in units of the square root of its own inertia; immovable dofs get 0.
    """
    inertia = jnp.diagonal(matrix)
    moves = inertia > 0.0
    scale = jnp.where(moves, jnp.sqrt(jnp.where(moves, inertia, 1.0)), 0.0)
    unit = jnp.where(moves, scale, 1.0)
    roundoff = INERTIA_ROUNDOFF * len(inertia) * jnp.finfo(matrix.dtype).eps
    lift = jnp.diag(jnp.where(moves, roundoff, 1.0))
    return jax.lax.linalg.cholesky(matrix / (unit[:, None] * unit) + lift, symmetrize_input=False).T * scale
