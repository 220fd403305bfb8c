"""Searches by steps of a scheme: for any tasks, limits with rows, priorities and floating bases."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from ..control._step import velocity_problem
from ..kinematics import Kinematics, difference, forward_kinematics, integrate
from ..limits import ConfigurationLimit, Limit, limit_rows
from ..numerics._arguments import numbers_for
from ..robot import Robot
from ..robot._joint_selection import dof_of_entries
from ..robot._ranges import independent_balls, with_balls_inside
from ..schemes import Scheme, VelocityProblem
from ..tasks import Task, TaskRows
from ..tasks._rows import rows_of
from ._linear import ISOLATED, positive_pivot
from ._pool import Errors, stepped
from ._seeds import unit_points
from ._task_minimum import has_minimum, ranks, rate_at_rest
from ._turns import unwound

_LONGEST = 1.0
"""Longest step of a coordinate [rad or m]."""
CURVATURE = 0.1
"""Factor of the schemes' curvature damping: with all of it steps are safe and short, and a search may go astray."""
_PREFERENCES = 0.05
"""Gain of the preferences, for each tolerance that the goals are off: 0 at the end."""
_FAINT = 0.01
"""The largest gain of the preferences on the way to a local optimum, which they are not to move."""
_ABOVE = 1e6
"""Factor of a level's squared errors over those of the next lower level."""
_LOOK, _MOST, _PROGRESS = 20, 400, 1e-4
"""Search for a local optimum: steps between checks, most steps, and the least relative decrease of the cost."""
_RADIAN = 0.1
"""Length that a radian of a task's error counts as [m], where rows are compared."""
CLEAR = 0.1
"""Fraction of the position tolerance by which limits with rows may be off."""
_SPREADS = 8
"""Searches start at this many distances from the first configuration, in turn."""


class Aims(NamedTuple):
    """Targets of the tasks of one search, where a batch has many."""

    number: Int[Array, "*n"]  # number of the target in the batch
    targets: dict[str, Any]  # targets by name of the task; other tasks keep their own


class TaskSearch(eqx.Module):
    """Search by steps of a scheme that ask for the whole error at once, limited by a longest step.

    The tasks' own curvature, as damping, keeps long steps in check. Tasks that are no goals fade out as the goals are
    met, so that a posture decides between solutions and never keeps the goals from being met.
    """

    robot: Robot
    turns: tuple[bool, ...] = eqx.field(static=True)  # of each entry of q, whether a whole turn of it changes no task
    tasks: dict[str, Task]  # all of them, gains 1
    scheme: Scheme  # whose steps are taken
    limits: tuple[Limit, ...]  # on configurations
    first: Float[Array, " nq"]  # where search 0 starts
    low: Float[Array, " nq"]  # of where searches start, of each entry of q
    high: Float[Array, " nq"]
    lower: Float[Array, " nq"]  # limits of each entry of q, -inf where free
    upper: Float[Array, " nq"]
    angles: Float[Array, " nv"]  # greatest angles of ball joints, in their three entries of v, inf where free
    shift: UInt[Array, " nq"]  # of the sequence of starts
    tolerance: Float[Array, "2"]  # of position [m] and orientation [rad]
    enough: Float[Array, ""]  # score at which a search stays where it is
    preferred: Float[Array, ""]  # largest gain of the preferences

    def begin(self, seed: Int[Array, " lanes"], goal: Aims) -> Float[Array, "lanes nq"]:
        """Return the starts of the searches: the first configuration, then points at growing distances from it."""
        unit = unit_points(self.shift, seed, self.low.dtype)
        points = self.low + (self.high - self.low) * unit
        ratio = ((seed + _SPREADS - 1) % _SPREADS + 1).astype(points.dtype) / _SPREADS
        ratio = jnp.where(seed == 0, 0.0, ratio)[:, None]
        q = jnp.clip(self.first + ratio * (points - self.first), self.lower, self.upper)
        return jax.vmap(self._with_balls_turned)(q, ratio * (2.0 * unit - 1.0))

    def _with_balls_turned(self, q: Float[Array, " nq"], share: Float[Array, " nq"]) -> Float[Array, " nq"]:
        """Return q with ball joints turned by shares of their range, or of half a turn; other joints stay."""
        velocity = jnp.zeros_like(self.angles)
        for joint in independent_balls(self.robot.tree):
            entry, dof = self.robot.tree.qpos_address[joint] + 1, self.robot.tree.dof_address[joint]
            greatest = jnp.minimum(self.angles[dof : dof + 3], jnp.pi)
            velocity = velocity.at[dof : dof + 3].set(greatest * share[entry : entry + 3])
        return self.after(q, velocity) if independent_balls(self.robot.tree) else q

    def advance(self, x: Float[Array, "lanes nq"], goal: Aims, steps: Any) -> tuple[Array, Array, Errors]:
        """Return the state after some steps: start and end of the last one, and the errors at its start."""
        return stepped(lambda q: jax.vmap(self.step)(q, goal), x, len(x), steps)

    def step(self, q: Float[Array, " nq"], goal: Aims) -> tuple[Float[Array, " nq"], Errors]:
        """Return the next configuration, and the errors at the present one. A finished search does not move."""
        errors = self.errors(q, goal)[1]
        gain = jnp.minimum(_PREFERENCES * errors.score, self.preferred).astype(q.dtype)
        tasks = {name: task if is_goal(task) else _faded(task, gain) for name, task in self.aimed(goal).items()}
        problem = self._problem(q, tasks)
        step = jnp.full_like(problem.lower, _LONGEST)
        problem = dataclasses.replace(
            problem, lower=jnp.clip(problem.lower, -step, step), upper=jnp.clip(problem.upper, -step, step)
        )
        velocity = self.scheme.solve(problem).velocity
        # a step that failed leaves the lane where it is, and the pool replaces it
        velocity = jnp.where(jnp.isfinite(velocity), jnp.clip(velocity, problem.lower, problem.upper), 0.0)
        return jnp.where(errors.score <= self.enough, q, self.after(q, velocity)), errors

    def newton_step(self, q: Float[Array, " nq"], goal: Aims) -> Float[Array, " nq"]:
        """Return the scheme's step by the goals alone."""
        return self.after(q, self.scheme.solve(self._problem(q, goals_of(self.aimed(goal)))).velocity) - q

    def moved(self, q: Float[Array, " nq"], goal: Aims, rates: Any) -> Float[Array, " nq"]:
        """Return the derivative of a solution q, or of a least error, for the rates of the search and the goal."""
        along = jax.jvp(lambda search, goal: search.newton_step(q, goal), (self, goal), rates)[1]
        if not has_minimum(self):
            return along
        reached = self.errors(q, goal)[1].score <= self.enough
        return jnp.where(reached, along, rate_at_rest(self, q, goal, rates))

    def errors(self, q: Float[Array, " nq"], goal: Aims) -> tuple[dict[str, TaskRows], Errors]:
        """Return the rows of the goals at q, and their errors."""
        goals = goals_of(self.aimed(goal))
        kinematics = forward_kinematics(self.robot, q)
        rows = rows_of(self.robot, kinematics, q, {name: task.during(1.0) for name, task in goals.items()})
        sizes = [sizes_of(goals[name], own) for name, own in rows.items()]
        position, orientation = (jnp.max(jnp.stack(part)) for part in zip(*sizes, strict=True))
        score = jnp.maximum(position / self.tolerance[0], orientation / self.tolerance[1])
        score = jnp.maximum(score, self._beyond_limits(kinematics, q) / (CLEAR * self.tolerance[0]))
        cost = sum((p / self.tolerance[0]) ** 2 + (o / self.tolerance[1]) ** 2 for p, o in sizes)
        return rows, Errors(position, orientation, score, jnp.asarray(cost))

    def _cost(self, q: Float[Array, " nq"], goal: Aims) -> Float[Array, ""]:
        rows, rank = self.errors(q, goal)[0], ranks(self)
        lowest = max(rank[name] for name in rows)
        levels = sorted({rank[name] for name in rows} | {lowest})
        squares = [
            _ABOVE ** (len(levels) - 1 - levels.index(rank[name])) * jnp.sum(own.weight * own.pull**2)
            for name, own in rows.items()
        ]
        beyond = jnp.maximum(self._beyond_limits(forward_kinematics(self.robot, q), q) - CLEAR * self.tolerance[0], 0.0)
        return sum(squares, _ABOVE ** len(levels) * beyond**2)

    def _beyond_limits(self, kinematics: Kinematics, q: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return the largest violation of the limits' rows; 0 if there are none."""
        others = [limit for limit in self.limits if not isinstance(limit, ConfigurationLimit)]  # ranges hold always
        bounds = limit_rows(self.robot, kinematics, q, others, 1.0)
        if bounds is None:
            return jnp.zeros((), q.dtype)
        return jnp.max(bounds.violation(jnp.zeros(self.robot.nv, q.dtype)), initial=0.0)

    def aimed(self, goal: Aims) -> dict[str, Task]:
        """Return the tasks with a goal's targets."""
        return self.tasks | {name: self.tasks[name].replace(target=target) for name, target in goal.targets.items()}

    def distance(self, q: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return the distance from the first configuration, over v."""
        return jnp.sqrt(jnp.sum(difference(self.robot, self.first, q) ** 2))

    def finishing(self, exact: bool) -> TaskSearch:
        """Return the search for the last steps: unchanged."""
        return dataclasses.replace(self, enough=jnp.zeros_like(self.enough)) if exact else self

    def isolated(self, x: Float[Array, "lanes nq"], goal: Aims) -> Bool[Array, " lanes"]:
        """Return whether a solution is isolated: every motion of the joints changes a goal that is an equality."""
        matrix = jax.vmap(self._equalities)(x, goal)
        if matrix.shape[1] < self.robot.nv:
            return jnp.zeros(len(x), bool)
        return positive_pivot(jnp.moveaxis(matrix, 0, -1)) > (ISOLATED * _RADIAN) ** 2

    def _equalities(self, q: Float[Array, " nq"], goal: Aims) -> Float[Array, "m nv"]:
        """Return the Jacobian of the goals that are equalities, a radian in units of ``_RADIAN``."""
        rows = {name: own for name, own in self.errors(q, goal)[0].items() if own.is_equality}
        scales = [np.where(self.tasks[name].are_lengths(len(own.error)), 1.0, _RADIAN) for name, own in rows.items()]
        parts = [
            jnp.where(own.weight > 0.0, scale, 0.0).astype(q.dtype)[:, None] * own.jacobian
            for own, scale in zip(rows.values(), scales, strict=True)
        ]
        return jnp.concatenate([jnp.zeros((0, self.robot.nv), q.dtype), *parts])

    def unwound(self, q: Float[Array, "*lanes nq"]) -> Float[Array, "*lanes nq"]:
        """Return the same poses, each joint turned as near to the first configuration as its limits allow.

        Of the two quaternions of a ball joint's rotation it is the one nearer to that of the first configuration.
        """
        q = unwound(q, self.first, self.lower, self.upper, self.turns)
        for joint in independent_balls(self.robot.tree):
            entries = self.robot.tree.qpos_address[joint] + np.arange(4)
            turn = q[..., entries]
            is_far = jnp.sum(turn * self.first[entries], -1, keepdims=True) < 0.0
            q = q.at[..., entries].set(jnp.where(is_far, -turn, turn))
        return q

    def costs(self, q: Float[Array, "lanes nq"], goal: Aims) -> Float[Array, " lanes"]:
        """Return the costs that ``local_optima`` lowers: weighted errors, those of higher levels above all."""
        return jax.vmap(self._cost)(q, goal)

    def local_optima(
        self, q: Float[Array, "lanes nq"], goal: Aims, open_: Bool[Array, " lanes"]
    ) -> tuple[Float[Array, "lanes nq"], Float[Array, " lanes"], Int[Array, " lanes"]]:
        """Return the points where fully damped steps come to rest, the costs there, and the steps taken."""
        calm = dataclasses.replace(
            self,
            scheme=damped(self.scheme, 1.0 / CURVATURE),
            enough=jnp.zeros_like(self.enough),
            preferred=_FAINT * jnp.ones_like(self.preferred),
        )

        def go_on(state: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
            best, lowest, at, moving, taken = state
            _, there, _ = calm.advance(at, goal, _LOOK)
            cost = calm.costs(there, goal)
            better = moving & (cost < lowest)
            still = moving & (cost < (1.0 - _PROGRESS) * lowest)
            taken = taken + jnp.where(moving, _LOOK, 0)
            return jnp.where(better[:, None], there, best), jnp.where(better, cost, lowest), there, still, taken

        start = q, calm.costs(q, goal), q, open_, jnp.zeros(len(q), jnp.int32)
        within = lambda state: (state[3] & (state[4] < _MOST)).any()  # noqa: E731
        end, cost, _, _, taken = jax.lax.while_loop(within, go_on, start)
        return end, jnp.sqrt(cost), taken

    def _problem(self, q: Array, tasks: dict[str, Task]) -> VelocityProblem:
        return velocity_problem(self.robot, forward_kinematics(self.robot, q), q, tasks, self.limits, 1.0)

    def after(self, q: Array, velocity: Array) -> Array:
        """Return q after a motion, within the limits of the joints."""
        moved = integrate(self.robot, q, velocity)
        bounded = jnp.isfinite(self.lower) | jnp.isfinite(self.upper)
        clipped = jnp.where(bounded, jnp.clip(moved, self.lower, self.upper), moved)
        return with_balls_inside(self.robot.tree, clipped, self.angles)


def damped(scheme: Scheme, factor: float) -> Scheme:
    """Return the scheme with its curvature damping multiplied by a factor."""
    if "curvature_damping" not in scheme.replaceable:
        return scheme
    return scheme.replace(curvature_damping=factor * scheme.curvature_damping)  # pyright: ignore


def _faded(task: Task, gain: Array) -> Task:
    """Return a preference that vanishes with the gain.

    Its weight fades too: rows that ask for no motion at full weight would damp the last steps to a solution.
    """
    given = {"gain": gain, "weight": gain * task.weight}
    return task.replace(**{name: value for name, value in given.items() if name in task.replaceable})


def is_goal(task: Task) -> bool:
    """Return whether a task has to be met for a configuration to be a solution."""
    return task.hard or task.is_goal


def goals_of(tasks: dict[str, Task]) -> dict[str, Task]:
    """Return the tasks that have to be met."""
    return {name: task for name, task in tasks.items() if is_goal(task)}


def sizes_of(task: Task, rows: TaskRows) -> tuple[Array, Array]:
    """Return the error of a task in metres and in radians; other units count as metres."""
    position = task.are_lengths(len(rows.error))
    residual = jnp.where(rows.weight > 0.0, rows.pull, 0.0)
    parts = (jnp.sum(jnp.where(mask, residual, 0.0) ** 2) for mask in (position, ~position))
    first, second = (jnp.sqrt(jnp.where(part > 0.0, part, 1.0)) * (part > 0.0) for part in parts)
    return first, second


def entry_limits(robot: Robot, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the limits of each entry of q, from those of each entry of v."""
    dof, numbers = dof_of_entries(robot), numbers_for(lower, upper)
    return numbers.where(dof >= 0, lower[dof], -np.inf), numbers.where(dof >= 0, upper[dof], np.inf)
