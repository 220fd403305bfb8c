"""Limit used as a task, which gives way to higher priorities."""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._errors import OsikTypeError, OsikValueError
from ..kinematics import Kinematics
from ..limits import Limit, limit_box, limit_rows
from ..robot import Robot
from ..robot._made_for import check_made_for
from ._gain import evaluate_gain
from ._leaves import as_scalar
from ._task import Task, TaskRows


class LimitTask(Task):
    """Inequality task made of a limit: it holds at its priority and gives way to higher ones.

    ``lower <= v <= upper``, one row for each dof, and then the limit's own rows, if it has any, at their bounds. There
    is no error that could decay: it is 0, and there is no gain. In ``inverse_kinematics`` a limit on velocities has no
    effect, as among ``limits``; others (joint ranges, collisions, planes) count there by their violation.

    Args:
        robot: the robot.
        limit: any limit.
        weight: of each squared row [rad/s, m/s, or the unit of the limit's row].

    Raises:
        TypeError: something that is no limit.
        ValueError: a negative weight, or a limit that was made for another robot.
    """

    limit: Limit
    dt: Float[Array, ""]

    def __init__(
        self,
        robot: Robot,
        limit: Limit,
        *,
        weight: ArrayLike | Array = 1.0,
        priority: int = 1,
        hard: bool = False,
    ):
        if not isinstance(limit, Limit):
            raise OsikTypeError(f"limit is a {type(limit).__name__}, not a Limit")
        check_made_for(limit, robot, "limit")
        self.limit = limit
        self.dt = as_scalar(1.0, "dt", self._set_up(robot, weight, priority, hard))

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return one row per dof, then the limit's rows, for the step of ``during`` (1 s by default)."""
        lower, upper = limit_box(robot, q, (self.limit,), self.dt)
        jacobian, own = jnp.eye(robot.nv, dtype=lower.dtype), limit_rows(robot, kinematics, q, (self.limit,), self.dt)
        if own is not None:
            parts = ((jacobian, own.jacobian), (lower, own.lower), (upper, own.upper))
            jacobian, lower, upper = (jnp.concatenate(part) for part in parts)
        return TaskRows(
            error=jnp.zeros_like(lower),
            jacobian=jacobian,
            lower=lower,
            upper=upper,
            weight=jnp.broadcast_to(self.weight, lower.shape),
            dofs=tuple(range(robot.nv)) if own is None else None,
            is_equality=False,
        )

    def sought(self, robot: Robot, q0: Float[Array, " nq"]) -> Task | None:
        """Return a task with the limit's violation as its error; None for a limit on velocities."""
        del q0
        limit = self.limit.sought(robot)
        if limit is None:
            return None
        kept = _Kept(robot, limit, weight=self.weight, priority=self.priority, hard=self.hard)  # pyright: ignore[reportArgumentType]
        return kept.replace(gain=1.0)

    def during(self, dt: Float[Array, ""] | float) -> Self:
        """Return the task for a step of dt [s]."""
        return eqx.tree_at(lambda task: task.dt, self, jnp.asarray(dt, self.dt.dtype))

    def after(self, velocity: Float[Array, " nv"]) -> Self:
        """Return the task for the next step, given this step's ``velocity`` [rad/s or m/s]."""
        return eqx.tree_at(lambda task: task.limit, self, self.limit.after(velocity))

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts."""
        return tuple(name for name in super().replaceable if name not in ("gain", "dt"))

    def _convert(self, name: str, value: Any) -> Any:
        if name != "limit":
            return super()._convert(name, value)
        if jax.tree.structure(value) != jax.tree.structure(self.limit):
            raise OsikValueError(f"limit is a {type(value).__name__} of another structure than the task's")
        return value


class _Kept(LimitTask):
    """Limit task of inverse kinematics: a step may go to a bound, and comes back from beyond it by the gain."""

    def rows(self, robot: Robot, kinematics: Kinematics, q: Float[Array, " nq"]) -> TaskRows:
        """Return the rows of the limit, with its violation as what they pull at."""
        own, gain = super().rows(robot, kinematics, q), evaluate_gain(self.gain, jnp.ones(()))
        return dataclasses.replace(
            own,
            lower=jnp.where(own.lower > 0.0, gain * own.lower, own.lower),
            upper=jnp.where(own.upper < 0.0, gain * own.upper, own.upper),
            # an upper bound below 0 asks to come down: positive, as an error above its bound
            pull=jnp.maximum(-own.upper, 0.0) - jnp.maximum(own.lower, 0.0),
        )

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts."""
        return ("gain", *super().replaceable)
