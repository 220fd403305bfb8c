"""Base class of tasks, and the rows that tasks give to schemes."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..kinematics import Kinematics, forward_kinematics
from ..numerics._dense import short_sum
from ..numerics._guarded import approach
from ..numerics._replace import Replaceable
from ..robot import Robot
from ..robot._made_for import MadeForRobot
from ._curvature import jacobian_curvature, levers, no_curvature
from ._gain import Gain, as_gain, capped_gain, evaluate_gain
from ._leaves import as_bounds, as_own_weight, as_weight, check_bounds
from ._repr import short_repr

DEFAULT_GAIN = 10.0
"""Default gain [1/s]. The error falls to 1/e in 0.1 s; Euler steps are monotone up to dt = 0.1 s and stable up to 0.2
s.
"""


class TaskRows(eqx.Module):
    """Rows of a task at one configuration: ``lower <= jacobian @ v <= upper``.

    Attributes:
        error: an equality task's ``e = x (-) x*``; an inequality task's value, the x that is bounded. (m,)
        jacobian: ``d error / dt = jacobian @ v`` for a target that stands still. (m, nv)
        lower: bound on ``jacobian @ v``. Equality: ``-gain e + x*'``; inequality: ``gain (lower - x) + x*'``. (m,)
        upper: the same as ``lower`` for an equality; inequality: ``gain (upper - x) + x*'``. (m,)
        weight: of the square of each row's residual. (m,)
        curvature: bound on the second derivative of the task's error along its own pull, ``|sum_i weight_i gain e_i
            grad^2 e_i|``: times dt, the most damping that a scheme adds for it (``_curvature.py``). 0 where the task is
            met, or linear in the joints. ()
        pull: ``gain e`` of each row, without the target's own velocity; of an inequality, what it is outside by. (m,)
        levers: how far each dof moves the rows, their weights' roots multiplied in; 0 for a dof that they are linear
            in. (nv,)
        dofs: where each row asks for one dof's velocity as it is, those dofs (static): ``jacobian`` is then those rows
            of the identity, which a scheme may use to save work. None elsewhere.
        is_equality: whether all rows are equalities, for which only ``lower`` counts (static). Where it is not said,
            rows are equalities if ``upper`` was given as the very array that is ``lower`` (``TaskRows(error, jacobian,
            wanted, wanted, weight)``). Other arrays of equal numbers are an interval of width 0, and so are those that
            came out of ``jit``, which returns a copy of each: schemes then find the same velocity with more work, but
            for the curvature damping, of which inequality rows get all.
        closes_loop: whether the rows are a constraint of the mechanism, which carries whatever force the tasks below it
            need (static).
        squares: the squared length of each row of the Jacobian, or None (``squared_lengths`` computes it). (m,)
    """

    error: Float[Array, " m"]
    jacobian: Float[Array, "m nv"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    weight: Float[Array, " m"]
    curvature: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    pull: Float[Array, "..."] = eqx.field(default=0.0, converter=jnp.asarray)
    levers: Float[Array, "..."] = eqx.field(default=0.0, converter=jnp.asarray)
    dofs: tuple[int, ...] | None = eqx.field(default=None, static=True)
    is_equality: bool = eqx.field(default=None, static=True)  # pyright: ignore[reportAssignmentType]  # None: not said
    closes_loop: bool = eqx.field(default=False, static=True)
    squares: Float[Array, "..."] | None = None

    def __post_init__(self) -> None:
        if self.is_equality is None:
            self.is_equality = self.lower is self.upper

    @classmethod
    def of(
        cls,
        error: Float[Array, " m"],
        jacobian: Float[Array, "m nv"],
        *,
        gain: Gain,
        weight: Float[Array, " m"],
        lower: Float[Array, " m"] | None = None,
        upper: Float[Array, " m"] | None = None,
        feedforward: Float[Array, " m"] | None = None,
        dofs: tuple[int, ...] | None = None,
        curvature: Callable[[Float[Array, " m"]], Float[Array, ""]] | None = None,
    ) -> TaskRows:
        """Return the rows of an equality task on ``error``, or of an inequality task if bounds are given.

        Equality: ``jacobian v = -gain(error) error + feedforward``. Inequality: ``gain (lower - error) + feedforward <=
        jacobian v <= gain (upper - error) + feedforward``; infinite bounds stay infinite, and an adaptive gain is
        evaluated at the distance of the value to the interval, 0 inside. Rows of weight 0 do not count for the gain.

        Args:
            error: of an equality, where the robot is less where it should be; of an inequality, the value itself, in
                its own units, such as m or rad. (m,)
            jacobian: derivative of ``error`` along v. (m, nv)
            gain: [1/s], a number or an adaptive gain.
            weight: of the squared residual of each row; 0 leaves the row out. (m,)
            lower: lower bounds of ``error``, with ``upper``; -inf for none. (m,)
            upper: upper bounds; inf for none. (m,)
            feedforward: the target's own velocity, in units of ``error`` a second; default 0. (m,)
            dofs: of rows that each ask for the velocity of one dof, which. (static)
            curvature: maps the weighted pull ``weight gain e`` (m,) to the rows' bound ``curvature``. Default: the
                pull's length times the size of the Jacobian, which is above what a chain of hinges can bend.
        """
        shift = jnp.zeros_like(error) if feedforward is None else feedforward
        linear = dofs is not None or curvature is no_curvature
        arms = jnp.zeros_like(jacobian[0]) if linear else levers(weight, jacobian)
        curvature_of = curvature or (
            no_curvature if dofs is not None else partial(jacobian_curvature, jacobian=jacobian)
        )
        if lower is None or upper is None:
            # rows of weight 0 take no part, so their errors must not change an adaptive gain
            pull = evaluate_gain(gain, jnp.where(weight > 0.0, error, 0.0)) * error
            # minus the pull: the velocity that takes the error to 0
            wanted = shift - pull
            return cls(
                error, jacobian, wanted, wanted, weight, curvature_of(weight * pull), pull, arms, dofs, is_equality=True
            )
        # signed like an error: positive above the interval, so that minus the pull leads back
        outside = jnp.maximum(error - upper, 0.0) - jnp.maximum(lower - error, 0.0)
        rate = evaluate_gain(gain, jnp.where(weight > 0.0, outside, 0.0))
        low, high = (approach(rate, bound, error) + shift for bound in (lower, upper))
        pull = rate * outside
        return cls(error, jacobian, low, high, weight, curvature_of(weight * pull), pull, arms, dofs, is_equality=False)

    def squared_lengths(self) -> Float[Array, " m"]:
        """Return the squared length of each row of the Jacobian."""
        return short_sum(self.jacobian**2) if self.squares is None else self.squares


class CoreCard(NamedTuple):
    """Facts by which the compiled step computes the rows of a task (``core/tasks``)."""

    kind: int  # ``POSE`` and so on: a place in ``TaskKinds`` (``core/tasks/kinds.hpp``)
    rows: int  # their number
    options: list[int]  # indices and flags of this kind


POSE, CENTER, POSTURE, GIVEN, POINTING = range(5)
"""Kinds of a step's rows; those of ``GIVEN`` are computed by JAX."""


class Task(MadeForRobot, Replaceable):
    """Base of all tasks: an immutable pytree.

    To make your own, subclass it, add fields and write ``rows`` (``TaskRows.of``). Every task takes ``priority`` and
    ``hard``.

    Attributes:
        priority: 1 is the most important; static.
        hard: whether the task is a constraint, above every priority (static): it is met to rounding, or the answer is
            INFEASIBLE and misses it, with all that is hard, by least squares with their weights.
        weight: of the task's squared residual against others in the same weighted problem or level; where a task says
            so, one for each of its rows.
        gain: [1/s], a constant or an ``AdaptiveGain``: the wanted error rate is ``-gain * error``. In a step of dt,
            more than ``1 / dt`` counts as that.
        is_goal: whether ``inverse_kinematics`` has to meet the task (static). If not, it prefers configurations that
            meet it. It has to meet hard tasks in any case.
        sees_places: whether a whole turn of a hinge leaves the task's error as it is, because it depends on the places
            of bodies alone (static).
        calms: whether the task calms a motion, which it cannot beneath tasks that leave its joints no freedom (static).
        ties_joints: whether the task, once met, leaves other tasks fewer ways to move its joints, as a closed loop does
            (static).
        units: unit of each number, by the field's name; that of ``""`` is of all numbers that are not named (static).
    """

    is_goal: ClassVar[bool] = False
    sees_places: ClassVar[bool] = False
    calms: ClassVar[bool] = False
    ties_joints: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"": "the task's own"})
    weight: Float[Array, "..."] = eqx.field(default=1.0, converter=as_own_weight, kw_only=True)
    gain: Gain = eqx.field(default=DEFAULT_GAIN, converter=lambda value: as_gain(value), kw_only=True)
    priority: int = eqx.field(default=1, static=True, kw_only=True)
    hard: bool = eqx.field(default=False, static=True, kw_only=True)

    def __check_init__(self) -> None:
        check_priority(self.priority)
        if not isinstance(self.hard, bool | np.bool_):
            raise OsikTypeError(f"hard is {self.hard!r}; it is True (a constraint, above every priority) or False")

    def _set_up(self, robot: Robot, weight: Any, priority: int, hard: bool, gain: Any = 0.0) -> Any:
        """Set the fields of every task, where ``_weight_rows`` is known; return the dtype of the robot's numbers."""
        dtype = robot.q0.dtype
        self.priority, self.hard = check_priority(priority), hard
        self.weight, self.gain = as_weight(weight, self._weight_rows, dtype), as_gain(gain, dtype)
        return dtype

    def _set_bounds(self, target: Any, lower: Any, upper: Any, rows: int, dtype: Any) -> bool:
        """Set ``lower`` and ``upper``; return whether the task has a target in their place, TypeError for both."""
        own: Any = self
        own.lower, own.upper = as_bounds(lower, upper, rows, dtype)
        if own.lower is not None and target is not None:
            raise OsikTypeError(f"this {type(self).__name__} has a target or bounds (lower, upper), not both")
        return own.lower is None

    @abc.abstractmethod
    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return error, Jacobian and wanted velocities at configuration q with given kinematics."""

    def during(self, dt: Float[Array, ""] | float) -> Self:
        """Return the task for a step of dt [s] as ``solve`` uses it, with a gain of at most 1 / dt.

        With 1 / dt a step takes all of the error. With more it overshoots, and from 2 / dt on errors grow.
        """
        return eqx.tree_at(lambda task: task.gain, self, capped_gain(self.gain, dt))

    def after(self, velocity: Float[Array, " nv"]) -> Self:
        """Return the task for the next step, given this step's ``velocity``; the task itself if it has no memory."""
        del velocity
        return self

    def sought(self, robot: Robot, q0: Float[Array, " nq"]) -> Task | None:
        """Return the task as ``inverse_kinematics`` uses it, or None if it says nothing about a configuration.

        Here: the same task with a gain of 1 and a target at rest.

        Args:
            robot: the robot.
            q0: configuration that a task on velocities is about. (nq,)
        """
        del robot, q0
        still = {"gain": 1.0, "target_velocity": 0.0}
        return self.replace(**{name: value for name, value in still.items() if name in self.replaceable})

    def unit_of(self, field: str) -> str:
        """Return the unit of a number of the task, by its name in the task, such as ``"target[0]"``."""
        if field.startswith("gain"):
            return {"gain.decay": "1 / unit of the error"}.get(field, "1/s")
        return "1" if "weight" in field else self.units.get(field, self.units.get("", "the task's own"))

    def are_lengths(self, count: int) -> Bool[np.ndarray, " m"]:
        """Return which of ``count`` rows are in metres; the other rows are in radians. Other units count as metres."""
        return np.ones(count, bool)

    def error_bounds(self) -> tuple[Any, Any] | None:
        """Return lower and upper bounds on the error (``TaskRows.error``) of an inequality task; None: an equality."""
        lower, upper = getattr(self, "lower", None), getattr(self, "upper", None)
        if lower is None and upper is None:
            return None
        return -np.inf if lower is None else lower, np.inf if upper is None else upper

    def grip(self) -> tuple[Array, Array | None] | None:
        """Return position [m] and rotation of the target as a viewer drags it, world axes; None: nothing to drag.

        The rotation is None if dragging moves the target and does not turn it.
        """
        return None

    def gripped(self, position: Float[np.ndarray, "3"], rotation: np.ndarray) -> Any:
        """Return the target whose ``grip`` is at a position [m] and a rotation, a matrix or a unit quaternion."""
        raise OsikTypeError(f"this {type(self).__name__} has no target to drag")

    def core(self, robot: Robot) -> CoreCard | str:
        """Return the card by which the compiled step computes the rows, or in words why JAX computes them.

        A subclass inherits no card: it may have rows of its own.
        """
        return self._card(robot) if "_card" in vars(type(self)) else f"is of the class {type(self).__name__}"

    def _card(self, robot: Robot) -> CoreCard | str:
        """Return what ``core`` returns, in each class that has a card."""
        raise NotImplementedError

    def core_leaves(self) -> list[Any]:
        """Return the leaves that the task's card in ``core/tasks`` reads, in its order; None for a missing one."""
        return []

    def counted_dofs(self, robot: Robot) -> tuple[int, ...]:
        """Return the entries of v of the joints whose whole turns may change the error."""
        return () if self.sees_places else tuple(range(robot.nv))

    def at(self, robot: Robot, q: Float[Array, " nq"]) -> Self:
        """Return the task with its target at configuration q, so that its error there is 0.

        What mink and pink call ``set_target_from_configuration``, as a new task. Works inside ``jit`` and under
        ``vmap``, and compiles nothing again.

        Args:
            robot: the robot.
            q: configuration. (nq,)

        Raises:
            TypeError: the task has no target that a configuration could set: it has bounds, or wants a velocity.
            ValueError: q has the wrong length or, outside jit, is not finite.
        """
        robot.check_configuration(q)
        return self.replace(**self._held(robot, forward_kinematics(robot, jnp.asarray(q)), jnp.asarray(q)))

    def _held(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> dict[str, Any]:
        """Return the fields with which the error at q is 0, by name (``target`` mostly)."""
        raise OsikTypeError(f"this {type(self).__name__} has no target that a configuration could set")

    @property
    def _weight_rows(self) -> int | None:
        """Return the number of entries that ``weight`` may have; None for a scalar only."""
        return None

    def _convert(self, name: str, value: Any) -> Any:
        """Return a new value of a field in the task's precision."""
        if name == "weight":
            return as_weight(value, self._weight_rows, self.weight.dtype, like=self.weight.shape)
        return as_gain(value, self.weight.dtype) if name == "gain" else super()._convert(name, value)

    def _check(self) -> None:
        check_bounds(getattr(self, "lower", None), getattr(self, "upper", None))

    def __repr__(self) -> str:
        return short_repr(self)


def check_priority(priority: int) -> int:
    """Return the priority as an int, or raise an error unless it is an integer from 1 up."""
    if isinstance(priority, bool) or not isinstance(priority, int | np.integer) or priority < 1:
        raise OsikValueError(
            f"a priority is an integer, 1 for the most important task, 2 for the next; got {priority!r}"
        )
    return int(priority)
