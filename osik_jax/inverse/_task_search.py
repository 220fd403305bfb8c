"""Searches by the schemes' own steps: any tasks, limits with rows, priorities, floating bases."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from ..control._step import velocity_problem
from ..kinematics import difference, forward_kinematics, integrate
from ..limits import ConfigurationLimit, Limit, limit_rows
from ..robot import Robot
from ..robot._balls import with_balls_inside
from ..robot._joint_selection import scalar_layout
from ..schemes import Scheme, VelocityProblem
from ..tasks import (
    AxisAlignTask,
    ComTask,
    ContactTask,
    EqualityConstraintTask,
    FrameTask,
    FunctionTask,
    JointCouplingTask,
    LookAtTask,
    RelativeFrameTask,
    Task,
    TaskRows,
)
from ..tasks._pose import PoseTask
from ..tasks._rows import rows_of
from ._pool import Errors
from ._seeds import unit_points

GOALS = (
    FrameTask,
    RelativeFrameTask,
    LookAtTask,
    AxisAlignTask,
    ComTask,
    ContactTask,
    EqualityConstraintTask,
    JointCouplingTask,
    FunctionTask,
)
"""Tasks on where things are, which have to be met; others are preferences. Hard tasks have to be met in any case."""
_TURNS = (LookAtTask, AxisAlignTask)
_LONGEST = 1.0
"""Longest step of a coordinate [rad or m]."""
CURVATURE = 0.1
"""Factor of the schemes' curvature damping: with all of it steps are safe and short, and a search may go astray."""
_PREFERENCES = 0.05
"""Gain of the preferences, for each tolerance that the goals are off: 0 at the end."""
_CLEAR = 0.1
"""Fraction of the position tolerance by which limits with rows may be off."""
_SPREADS = 8
"""Searches start at this many distances from the first configuration, in turn."""


class Aims(NamedTuple):
    """What one of many targets is.

    Attributes:
        number: of the target.
        targets: of tasks, by name; the others keep their own.
    """

    number: Int[Array, "*n"]
    targets: dict[str, Any]


class TaskSearch(eqx.Module):
    """Steps of a scheme with every error asked to vanish at once, and no limit on speeds but a longest step.

    The tasks' own curvature, as damping, keeps long steps in check. Tasks that are no goals fade out as the goals are
    met, so that a posture decides between solutions and never keeps the goals from being met.

    Attributes:
        robot: the robot.
        tasks: all of them, gains 1.
        scheme: whose steps are taken.
        limits: on configurations.
        first: where search 0 starts. (nq,)
        low: of where searches start, of each entry of q. (nq,)
        high: (nq,)
        lower: limits of each entry of q, -inf where free. (nq,)
        upper: (nq,)
        angles: greatest angles of ball joints, in their three entries of v, inf where free. (nv,)
        shift: of the sequence of starts. (nq,)
        tolerance: of position [m] and orientation [rad]. (2,)
        enough: score at which a search stays where it is. ()
    """

    robot: Robot
    tasks: dict[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]
    first: Float[Array, " nq"]
    low: Float[Array, " nq"]
    high: Float[Array, " nq"]
    lower: Float[Array, " nq"]
    upper: Float[Array, " nq"]
    angles: Float[Array, " nv"]
    shift: UInt[Array, " nq"]
    tolerance: Float[Array, "2"]
    enough: Float[Array, ""]

    def begin(self, seed: Int[Array, " lanes"], goal: Aims) -> Float[Array, "lanes nq"]:
        """Where a search with this number starts: the first configuration, then points ever further from it."""
        del goal
        points = self.low + (self.high - self.low) * unit_points(self.shift, seed, self.low.dtype)
        ratio = ((seed + _SPREADS - 1) % _SPREADS + 1).astype(points.dtype) / _SPREADS
        ratio = jnp.where(seed == 0, 0.0, ratio)[:, None]
        return jnp.clip(self.first + ratio * (points - self.first), self.lower, self.upper)

    def advance(self, x: Float[Array, "lanes nq"], goal: Aims, steps: int) -> tuple[Array, Array, Errors]:
        """Some steps: where the last one set out, where it led, and the errors of where it set out."""

        def step(_: Array, carry: tuple[Array, Array, Errors]) -> tuple[Array, Array, Errors]:
            after, errors = jax.vmap(self.step)(carry[1], goal)
            return carry[1], after, errors

        nothing = jnp.zeros(len(x), x.dtype)
        return jax.lax.fori_loop(0, steps, step, (x, x, Errors(nothing, nothing, nothing, nothing)))

    def step(self, q: Float[Array, " nq"], goal: Aims) -> tuple[Float[Array, " nq"], Errors]:
        """Where a step leads, and the errors of where it sets out. A search that is done stays."""
        errors = self.errors(q, goal)[1]
        gain = jnp.minimum(_PREFERENCES * errors.score, 1.0)
        faded = {
            name: task if is_goal(task) else task.replace(gain=gain.astype(q.dtype))
            for name, task in self.aimed(goal).items()
        }
        problem = self._problem(q, faded)
        step = jnp.full_like(problem.lower, _LONGEST)
        problem = dataclasses.replace(
            problem, lower=jnp.clip(problem.lower, -step, step), upper=jnp.clip(problem.upper, -step, step)
        )
        velocity = self.scheme.solve(problem).velocity
        velocity = jnp.where(jnp.isfinite(velocity), jnp.clip(velocity, problem.lower, problem.upper), 0.0)
        return jnp.where(errors.score <= self.enough, q, self._moved(q, velocity)), errors

    def newton_step(self, q: Float[Array, " nq"], goal: Aims) -> Float[Array, " nq"]:
        """The scheme's step by the goals alone."""
        goals = {name: task for name, task in self.aimed(goal).items() if is_goal(task)}
        return self._moved(q, self.scheme.solve(self._problem(q, goals)).velocity) - q

    def errors(self, q: Float[Array, " nq"], goal: Aims) -> tuple[dict[str, TaskRows], Errors]:
        """The goals' rows at q, and how far it is from meeting them."""
        goals = {name: task for name, task in self.aimed(goal).items() if is_goal(task)}
        kinematics = forward_kinematics(self.robot, q)
        rows = rows_of(self.robot, kinematics, q, {name: task.during(1.0) for name, task in goals.items()})
        sizes = [sizes_of(goals[name], own) for name, own in rows.items()]
        position, orientation = (jnp.max(jnp.stack(part)) for part in zip(*sizes, strict=True))
        score = jnp.maximum(position / self.tolerance[0], orientation / self.tolerance[1])
        others = [limit for limit in self.limits if not isinstance(limit, ConfigurationLimit)]  # ranges hold always
        bounds = limit_rows(self.robot, kinematics, q, others, 1.0)
        if bounds is not None:
            missed = jnp.max(bounds.violation(jnp.zeros(self.robot.nv, q.dtype)), initial=0.0)
            score = jnp.maximum(score, missed / (_CLEAR * self.tolerance[0]))
        cost = sum((p / self.tolerance[0]) ** 2 + (o / self.tolerance[1]) ** 2 for p, o in sizes)
        return rows, Errors(position, orientation, score, jnp.asarray(cost))

    def aimed(self, goal: Aims) -> dict[str, Task]:
        """The tasks with a goal's targets."""
        return {
            **self.tasks,
            **{name: self.tasks[name].replace(target=target) for name, target in goal.targets.items()},
        }

    def distance(self, q: Float[Array, " nq"]) -> Float[Array, ""]:
        """From the first configuration, over v."""
        return jnp.sqrt(jnp.sum(difference(self.robot, self.first, q) ** 2))

    def finishing(self) -> TaskSearch:
        """The same search, for the last steps."""
        return self

    def _problem(self, q: Array, tasks: dict[str, Task]) -> VelocityProblem:
        return velocity_problem(self.robot, forward_kinematics(self.robot, q), q, tasks, self.limits, 1.0)

    def _moved(self, q: Array, velocity: Array) -> Array:
        after = integrate(self.robot, q, velocity)
        bounded = jnp.isfinite(self.lower) | jnp.isfinite(self.upper)
        clipped = jnp.where(bounded, jnp.clip(after, self.lower, self.upper), after)
        return with_balls_inside(self.robot.tree, clipped, self.angles)


def is_goal(task: Task) -> bool:
    """Whether a task has to be met for a configuration to be a solution."""
    return task.hard or isinstance(task, GOALS)


def sizes_of(task: Task, rows: TaskRows) -> tuple[Array, Array]:
    """Length of what a task is off in metres and in radians; what is in other units counts as metres."""
    position = position_rows(task, len(rows.error))
    residual = jnp.where(rows.weight > 0.0, rows.pull, 0.0)
    parts = (jnp.sum(jnp.where(mask, residual, 0.0) ** 2) for mask in (position, ~position))
    first, second = (jnp.sqrt(jnp.where(part > 0.0, part, 1.0)) * (part > 0.0) for part in parts)
    return first, second


def position_rows(task: Task, count: int) -> np.ndarray:
    """Which rows of a task are in metres, the others being in radians."""
    number = np.arange(count)
    if isinstance(task, PoseTask):
        return np.flatnonzero(task.kept) < 3
    if isinstance(task, ContactTask):
        return number < (1 if task.sliding else 3)
    return np.full(count, not isinstance(task, _TURNS))


def entry_limits(robot: Robot, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Limits of each entry of q, from those of each entry of v."""
    scalar, index = scalar_layout(robot)
    low, high = jnp.full(robot.nq, -jnp.inf, lower.dtype), jnp.full(robot.nq, jnp.inf, upper.dtype)
    return low.at[index[scalar]].set(lower[scalar]), high.at[index[scalar]].set(upper[scalar])
