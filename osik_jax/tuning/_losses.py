"""Losses of trajectories."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import unknown_name
from ..control import Trajectory
from ..kinematics import center_of_mass, forward_kinematics
from ..robot._joint_selection import scalar_layout
from ..robot._tree import FREE
from ..tasks import SupportPolygon, Task
from ._loop import Loop

LossFunction = Callable[[Trajectory, Loop], Float[Array, ""]]
"""A scalar from one scenario's trajectory and the loop that ran it, its robot, targets and parameters in place."""


class Loss(eqx.Module):
    """Base of losses that can be added and scaled: ``Tracking("hand") + 0.1 * Smoothness()``."""

    @abc.abstractmethod
    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the loss of one trajectory."""

    def __add__(self, other: LossFunction) -> Loss:
        return WeightedSum((self, other), jnp.ones(2)) if callable(other) else NotImplemented

    def __radd__(self, other: LossFunction | int) -> Loss:
        if callable(other):
            return WeightedSum((other, self), jnp.ones(2))
        return self if other == 0 else NotImplemented  # sum() begins with 0

    def __mul__(self, factor: ArrayLike | Array) -> Loss:
        return WeightedSum((self,), jnp.asarray(factor, float)[None])

    __rmul__ = __mul__


class WeightedSum(Loss):
    """Several losses, each times a weight."""

    losses: tuple[LossFunction, ...]  # functions of a trajectory and a loop, ready ones and others
    weights: Float[Array, " k"]  # one for each

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the sum."""
        return sum(
            (weight * loss(trajectory, loop) for weight, loss in zip(self.weights, self.losses, strict=True)),
            start=jnp.zeros((), trajectory.q.dtype),
        )


class Tracking(Loss):
    """Mean over time of the squared error of tasks, summed over their rows [m^2, rad^2].

    The error of an inequality task is how far its value is outside its bounds. Row weights do not count: they may be
    what is tuned.

    Attributes:
        names: of the tasks; none: all of them. (static)
        after: counts from this time on [s]: for how a motion ends, and not how it gets there.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    after: Float[Array, ""]

    def __init__(self, *names: str, after: ArrayLike | Array = 0.0):
        self.names, self.after = names, jnp.asarray(after, float)

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the mean squared error."""
        errors, tasks = trajectory.solution.error, _tasks_in_time(loop, trajectory.time)
        for name in self.names:
            if name not in errors:
                raise unknown_name("task", name, tuple(errors))
        squares = [_squared_miss(errors[name], tasks[name]) for name in self.names or errors]
        return _mean_over_time(sum(squares[1:], start=squares[0]), trajectory.time >= self.after - 0.5 * loop.dt)


def _tasks_in_time(loop: Loop, time: Float[Array, " steps"]) -> Mapping[str, Task]:
    """Return the tasks; those from a function of time have a leading axis of steps."""
    return jax.vmap(loop.tasks)(time) if callable(loop.tasks) else loop.tasks


def _squared_miss(error: Float[Array, "steps m"], task: Task) -> Float[Array, " steps"]:
    bounds = task.error_bounds()
    if bounds is not None:
        lower, upper = bounds
        error = jnp.minimum(error - lower, 0.0) + jnp.maximum(error - upper, 0.0)
    return jnp.sum(error**2, -1)


def _mean_over_time(values: Float[Array, " steps"], counted: Array) -> Float[Array, ""]:
    return jnp.sum(jnp.where(counted, values, 0.0)) / jnp.maximum(jnp.sum(counted), 1)


class Smoothness(Loss):
    """Mean over time of the squared acceleration, summed over v [rad^2/s^4, m^2/s^4], by differences between steps.

    Attributes:
        from_rest: whether the first step counts, with a velocity of zero before it. (static)
    """

    from_rest: bool = eqx.field(static=True, default=True)

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the mean squared acceleration."""
        velocity = trajectory.solution.velocity
        before = jnp.zeros_like(velocity[:1]) if self.from_rest else velocity[:0]
        change = jnp.diff(jnp.concatenate([before, velocity]), axis=0) / loop.dt
        return jnp.sum(change**2) / jnp.maximum(change.shape[0], 1)


class Effort(Loss):
    """Mean over time of the squared speed, summed over the joints [rad^2/s^2, m^2/s^2]; a free base has no motor."""

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the mean squared speed."""
        tree = loop.robot.tree
        driven = np.array(tree.joint_types)[tree.dof_joint[tree.own_dofs]] != FREE
        return jnp.mean(jnp.sum(jnp.where(driven, trajectory.solution.velocity, 0.0) ** 2, -1))


class JointLimitDistance(Loss):
    """Depth of the joints in a margin before their limits: 0 outside it, 1 for a joint at its limit all the time.

    Mean over time of the squares, summed over the joints that have two limits (the robot's own).

    Attributes:
        margin: as a share of each joint's range, up to 0.5.
    """

    margin: Float[Array, ""] = eqx.field(default=0.1, converter=lambda value: jnp.asarray(value, float))

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the mean squared depth in the margin."""
        robot = loop.robot
        scalar, index = scalar_layout(robot)
        lower, upper = robot.position_lower, robot.position_upper
        limited = scalar & jnp.isfinite(lower) & jnp.isfinite(upper) & (upper > lower)
        low, high = jnp.where(limited, lower, 0.0), jnp.where(limited, upper, 1.0)
        share = (trajectory.q[1:, index] - low) / (high - low)
        depth = jnp.maximum(self.margin - jnp.minimum(share, 1.0 - share), 0.0) / self.margin
        return jnp.mean(jnp.sum(jnp.where(limited, depth, 0.0) ** 2, -1))


class ComMargin(Loss):
    """Loss of balance: squared depth of the centre of mass in a margin of the support polygon, mean over time [m^2].

    Attributes:
        polygon: see ``osik_jax.support_polygon``.
        margin: the wanted distance to the edge [m].
    """

    polygon: SupportPolygon
    margin: Float[Array, ""] = eqx.field(default=0.02, converter=lambda value: jnp.asarray(value, float))

    def __call__(self, trajectory: Trajectory, loop: Loop) -> Float[Array, ""]:
        """Return the mean squared depth in the margin."""

        def depth(q: Any) -> Float[Array, ""]:
            point = center_of_mass(loop.robot, forward_kinematics(loop.robot, q))
            return jnp.maximum(self.margin - self.polygon.distance(point[:2]), 0.0)

        return jnp.mean(jax.lax.map(jax.checkpoint(depth), trajectory.q[1:]) ** 2)
