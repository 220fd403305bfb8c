"""The loop: one tick, and many."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from ._blocks import BLOCK
from ._checks import (
    check_rows,
    check_setting,
    check_steps,
    check_target_names,
    check_targets,
    check_tasks,
    check_warm_start,
    checked_configuration,
    checked_limits,
    solved_with,
)
from ._errors import OsikValueError
from ._joint_selection import scalar_layout
from ._rules import FOUND, blocked
from ._sanity import cleaned, positive
from ._structure import Static, put_together, taken_apart
from .kinematics import Kinematics, forward_kinematics, integrate
from .limits import ConfigurationLimit, Limit, VelocityLimit, limit_box, limit_rows
from .robot import Robot
from .schemes import Scheme, VelocityProblem, WeightedQP
from .solvers import Status
from .tasks import Task
from .tasks._rows import rows_of

Tasks = Mapping[str, Task]
Targets = Mapping[str, Any]
Feedback = Callable[[Array, Array], Array]
_Carry = tuple[Array, Any, Any]
"""What a tick leaves to the next: configuration, velocity and warm start."""


class Solution(eqx.Module):
    """Answer of one tick (or, with a leading axis, of many).

    Attributes:
        velocity: v; under ``WeightedQP`` and ``HierarchicalQP`` inside its box exactly. ``WeightedQP`` returns, by
            status: SOLVED, the best; INFEASIBLE, the one that misses what is hard least; MAX_ITERATIONS, a careful
            step downhill, in the box and no worse than standing still; NUMERICAL_ERROR, zero, clipped into the box.
            (nv,)
        status: a ``Status`` code.
        iterations: changes of the active set, all levels together.
        factorizations: systems factored, all levels together; 1 in ``WeightedQP`` where the warm start was right.
        kkt_residual: largest violation of the optimality conditions (of the first level for ``NullSpace``), of
            ``WeightedQP`` as a share of the forces that the tasks exert: comparable between problems, at most 1e-9
            (1e-5 in float32) where SOLVED. The largest finite number where the status is NUMERICAL_ERROR.
        box_violation: how far v leaves its box [rad/s or m/s], 0 but for ``NullSpace``; or, where that is more, how far
            it leaves the rows of limits that are no box, in their units: rounding, but for ``NullSpace`` and where the
            status is INFEASIBLE.
        slack: of each task, J v minus the nearest point of its interval: what the task did not get. {name: (m,)}
        error: of each task, its error (equality) or value (inequality) at q. {name: (m,)}
        warm_start: for the next tick: the active set, as a pytree of integers; None for ``NullSpace``.

    All numbers are finite: what a NaN in the input spoils is 0, its derivatives too, and the status says so.
    """

    velocity: Float[Array, " nv"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    box_violation: Float[Array, ""]
    slack: dict[str, Float[Array, " m"]]
    error: dict[str, Float[Array, " m"]]
    warm_start: Any


class Trajectory(eqx.Module):
    """What a rollout went through.

    Attributes:
        time: at the start of each tick [s]. (steps,)
        q: configurations, the start first; ``q[k + 1]`` is where tick k led. (steps + 1, nq)
        solution: of each tick; every leaf has a leading axis. (steps, ...)
    """

    time: Float[Array, " steps"]
    q: Float[Array, "steps_1 nq"]
    solution: Solution


def solve(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks,
    *,
    scheme: Scheme | None = None,
    limits: Sequence[Limit] | None = None,
    dt: Float[Array, ""] | float = 0.005,
    targets: Targets | None = None,
    warm_start: Any = None,
) -> Solution:
    """The velocity that serves the tasks best at configuration q.

    Compiled on first use; changing any number (target, weight, gain, limit, dt, link length) compiles nothing. Pure, so
    it can be used inside ``jit`` and batched by ``vmap`` over q and over any leaf of robot, tasks, scheme and limits.

    Args:
        robot: the robot.
        q: configuration. (nq,)
        tasks: by name; the names come back in ``slack`` and ``error``.
        scheme: ``WeightedQP()``, ``NullSpace()`` or ``HierarchicalQP()``. Default: ``WeightedQP()``.
        limits: hard bounds on the velocity. Default: the robot's own, ``(ConfigurationLimit(robot),
            VelocityLimit(robot))``; ``()``: none. Those that remember the last tick's velocity, such as
            ``AccelerationLimit``, need it each time: ``limit.after(solution.velocity)``.
        dt: time until the next tick [s].
        targets: of some tasks, by name: what ``task.replace(target=...)`` takes, such as a pose as (position, rotation
            matrix), (position, quaternion w x y z), a 4 x 4 matrix or a ``jaxlie.SE3``. The other tasks keep theirs.
        warm_start: that of the tick before (``Solution.warm_start``), with the same tasks, scheme and limits. It saves
            time and does not change the answer; one with wrong numbers costs time only.

    Returns:
        The answer. What can be known of numbers only when they are there, such as a traced dt <= 0, raises nothing:
        look at ``status``, or call ``osik_jax.solvers.raise_if_failed`` outside jit.

    Raises:
        KeyError: ``targets`` names a task that does not exist.
        TypeError: something that is no robot, task, scheme or limit, or no number.
        ValueError: q of the wrong length, not finite or with a quaternion of zeros; no task; dt <= 0; a task or limit
            that was made for another robot, the warm start of another problem; a robot that is a stack, or that has
            float64 numbers while ``jax_enable_x64`` is off.

    Warns:
        OsikWarning: a robot that has float32 numbers while ``jax_enable_x64`` is on.
    """
    check_setting("solve(robot, q, tasks)", robot, scheme, dt)
    limits = checked_limits(robot, limits)
    check_tasks(tasks, robot)
    check_target_names(tasks, targets)
    check_warm_start(warm_start)
    q = checked_configuration(robot, q)
    return _solve(robot, q, aim(dict(tasks), targets), scheme, limits, _tick(dt, q), warm_start)


def build_problem(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks,
    *,
    limits: Sequence[Limit] | None = None,
    dt: Float[Array, ""] | float = 0.005,
    targets: Targets | None = None,
) -> VelocityProblem:
    """What ``solve`` hands to its scheme: the rows of the tasks, the box and the rows of the limits, assembled.

    For solvers of your own, and to look at the numbers: ``problem.rows["hand"].jacobian``, ``problem.lower``. A scheme
    takes it: ``scheme.solve(problem).velocity``. Pure; it is not compiled here, so call it inside your own ``jit``,
    together with what uses it.

    Args:
        robot: the robot.
        q: configuration. (nq,)
        tasks: as in ``solve``.
        limits: as in ``solve``.
        dt: as in ``solve``.
        targets: as in ``solve``.

    Raises:
        KeyError, TypeError, ValueError: as in ``solve``.
    """
    check_setting("build_problem(robot, q, tasks)", robot, None, dt)
    bounds = _own_limits(robot, checked_limits(robot, limits))
    check_tasks(tasks, robot)
    check_target_names(tasks, targets)
    q = checked_configuration(robot, q)
    aimed = aim(dict(tasks), targets)
    return _velocity_problem(robot, forward_kinematics(robot, q), q, aimed, bounds, _tick(dt, q))


@jax.jit
@blocked(BLOCK)
def _solve(
    robot: Robot,
    q: Array,
    tasks: dict[str, Task],
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    dt: Array | float,
    warm_start: Any = None,
) -> Solution:
    chosen, bounds = _own_scheme(q, scheme), _own_limits(robot, limits)
    dt = positive(dt)
    raw_box = jax.lax.stop_gradient(limit_box(robot, q, bounds, dt))
    (robot, q), posed = cleaned((robot, q))
    (chosen, bounds, dt), set_up = cleaned((chosen, bounds, dt))
    looked_at = {name: cleaned(task) for name, task in tasks.items()}
    tasks, sound = (
        {k: task for k, (task, _) in looked_at.items()},
        {k: posed & own for k, (_, own) in looked_at.items()},
    )
    kinematics = forward_kinematics(robot, q)
    problem = _velocity_problem(robot, kinematics, q, tasks, bounds, dt)
    given = _spoiled(problem, raw_box, jnp.stack([set_up, *sound.values()]).all())
    answer = solved_with(chosen, given, warm_start)
    v = answer.velocity
    failed = answer.status == Status.NUMERICAL_ERROR
    return Solution(
        velocity=v,
        status=answer.status,
        iterations=answer.iterations,
        factorizations=answer.factorizations,
        kkt_residual=jnp.where(failed, jnp.finfo(v.dtype).max, answer.kkt_residual),
        box_violation=jnp.max(_finite(_beyond_limits(given, v))),
        slack={name: _finite(jnp.where(sound[name], slack, 0.0)) for name, slack in problem.slack(v).items()},
        error={name: _finite(jnp.where(sound[name], rows.error, 0.0)) for name, rows in problem.rows.items()},
        warm_start=answer.warm_start,
    )


def _spoiled(problem: VelocityProblem, raw_box: tuple[Array, Array], fine: Array) -> VelocityProblem:
    """The problem with NaN back where its numbers are not to be had from: the solver says so, in every scheme.

    It comes in through a select, so that derivatives with respect to what the problem was made of are 0 in that lane.
    """
    rows = {
        name: replace(r, jacobian=jnp.where(fine, r.jacobian, jnp.nan), weight=jnp.where(fine, r.weight, jnp.nan))
        for name, r in problem.rows.items()
    }
    lower, upper = (
        jnp.where(jnp.isnan(raw), raw, b) for raw, b in zip(raw_box, (problem.lower, problem.upper), strict=True)
    )
    return replace(problem, rows=rows, lower=lower, upper=upper)


def _beyond_limits(problem: VelocityProblem, v: Float[Array, " nv"]) -> Float[Array, " m"]:
    """How far v leaves its box, then its rows."""
    box = jnp.maximum(jnp.maximum(problem.lower - v, v - problem.upper), 0.0)
    return box if problem.limit_rows is None else jnp.concatenate([box, problem.limit_rows.violation(v)])


def _finite(x: Array) -> Array:
    return jnp.where(jnp.isfinite(x), x, 0.0)


def rollout(
    robot: Robot,
    q0: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks | Callable[[Array], Tasks],
    *,
    scheme: Scheme | None = None,
    limits: Sequence[Limit] | None = None,
    dt: Float[Array, ""] | float = 0.005,
    steps: int,
    targets: Targets | None = None,
    feedback: Feedback | Float[ArrayLike, "steps nq"] | None = None,
) -> Trajectory:
    """The closed loop: solve, integrate, repeat, in one compiled scan.

    Differentiable in both modes. The reverse mode keeps of each tick the configuration and what the solver found, and
    computes the rest of it again on its way back: a long path costs little memory.

    Args:
        robot: the robot.
        q0: start. (nq,)
        tasks: by name, or a function from time [s] to tasks (the same ones each time, with other numbers). A function
            that is a pytree, such as an ``equinox.Module`` with ``__call__``, may change its numbers (arrays and
            floats; integers are static) without compiling; any other function compiles once for each object.
        scheme: as in ``solve``.
        limits: as in ``solve``. Limits and tasks that remember the last velocity get it at each tick; the
            first takes them as they are.
        dt: time of one tick [s].
        steps: number of ticks (static).
        targets: targets of some tasks at each tick, by task name: what ``replace(target=...)`` takes, with a leading
            axis of length ``steps`` on every array.
        feedback: measured configurations: an array with one for each tick (steps, nq), or a function of time [s] and of
            the configuration that the last tick led to, which returns the one measured. Default: no feedback. The
            trajectory holds where the ticks led, not what was measured.

    Returns:
        The trajectory. Every tick applies its velocity, whatever the status (``Solution.velocity`` says what it is);
        one that failed on a NaN in q or dt moves nothing: look at ``solution.status``.

    Raises:
        TypeError, ValueError: as in ``solve``; ``targets``, ``feedback`` or ``steps`` do not fit.
        KeyError: ``targets`` names a task that does not exist.
    """
    check_setting("rollout(robot, q0, tasks)", robot, scheme, dt)
    limits = checked_limits(robot, limits)
    check_steps(steps)
    check_targets(tasks, targets, steps, robot)
    if feedback is not None and not callable(feedback):
        feedback = jnp.asarray(feedback)
        if feedback.shape != (steps, robot.nq):
            raise OsikValueError(
                f"feedback has shape {feedback.shape}; it is one configuration a tick, {(steps, robot.nq)}"
            )
    numbers, static = taken_apart((tasks if callable(tasks) else dict(tasks), feedback))
    q0 = checked_configuration(robot, q0)
    return _rollout(
        robot,
        q0,
        numbers,
        scheme,
        limits,
        _tick(dt, q0),
        targets,
        static=static,
        steps=steps,
    )


@partial(jax.jit, static_argnames=("static", "steps"))
def _rollout(
    robot: Robot,
    q0: Array,
    numbers: Any,
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    dt: Array | float,
    targets: Targets | None,
    *,
    static: Static,
    steps: int,
) -> Trajectory:
    tasks, feedback = put_together(numbers, static)
    time = jnp.arange(steps) * dt
    measured = None if callable(feedback) else feedback

    def tick(state: _Carry, now: tuple[Array, Targets | None, Array | None]) -> tuple[_Carry, tuple[Array, Solution]]:
        (q, velocity, warm_start), (t, target, sensed) = state, now
        if callable(feedback):
            q = checked_configuration(robot, feedback(t, q))
        elif sensed is not None:
            q = sensed.astype(q.dtype)
        todo = _checked(tasks(t), robot) if callable(tasks) else aim(tasks, target)
        todo, kept = remembering((todo, limits), velocity, t > 0.0)
        solution = _solve(robot, q, todo, scheme, kept, dt, warm_start)
        q = _move(robot, q, solution.velocity, dt)
        return (q, solution.velocity, solution.warm_start), (q, solution)

    ticks = (time, targets, measured)
    cold = _cold_start(lambda now: tick((q0, None, None), now)[0][1:], ticks)
    thrifty = jax.checkpoint(tick, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(FOUND))
    _, (q, solution) = jax.lax.scan(thrifty, (q0, *cold), ticks, length=steps)
    return Trajectory(time, jnp.concatenate([q0[None], q]), solution)


def remembering(tasks_and_limits: Any, velocity: Float[Array, " nv"] | None, moved: Bool[Array, ""] | bool) -> Any:
    """Tasks and limits ``after`` a tick's velocity; as they are where there was no tick (``moved`` is false)."""

    def one(part: Task | Limit) -> Task | Limit:
        if velocity is None or type(part).after in (Task.after, Limit.after):
            return part
        return jax.tree.map(lambda new, old: jnp.where(moved, new, old), part.after(velocity), part)

    return jax.tree.map(one, tasks_and_limits, is_leaf=lambda part: isinstance(part, Task | Limit))


def _move(robot: Robot, q: Array, v: Array, dt: Array | float) -> Array:
    """Where a tick leads; nowhere if q or dt is NaN."""
    (clean, tick), fine = cleaned((q, jnp.asarray(dt)))
    return jnp.where(fine, integrate(robot, clean, v, tick).astype(q.dtype), q)


def _cold_start(tick: Callable[[Any], Any], ticks: Any) -> Any:
    """Zeros in the shape of what a tick leaves to the next, from one that is traced and not run."""
    one = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), jax.tree.map(jnp.asarray, ticks))
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(tick, one))


def aim(tasks: dict[str, Task], targets: Targets | None) -> dict[str, Task]:
    """The tasks with this tick's targets."""
    aimed = {name: tasks[name].replace(target=target) for name, target in (targets or {}).items()}
    return {**tasks, **aimed}


def _velocity_problem(
    robot: Robot,
    kinematics: Kinematics,
    q: Array,
    tasks: dict[str, Task],
    limits: tuple[Limit, ...],
    dt: Array | float,
) -> VelocityProblem:
    lower, upper = limit_box(robot, q, limits, dt)
    scalar, index = scalar_layout(robot)
    low, high = jnp.full_like(lower, -jnp.inf), jnp.full_like(upper, jnp.inf)
    for limit in limits:
        if isinstance(limit, ConfigurationLimit):
            low, high = jnp.maximum(low, limit.lower), jnp.minimum(high, limit.upper)
    rows = rows_of(robot, kinematics, q, {name: task.during(dt) for name, task in tasks.items()})
    check_rows(rows, tasks, robot)
    return VelocityProblem(
        rows=rows,
        priorities=tuple((name, task.priority) for name, task in tasks.items()),
        lower=lower,
        upper=upper,
        position=jnp.where(scalar, q[index], 0.0),
        position_lower=jnp.where(scalar, low, -jnp.inf),
        position_upper=jnp.where(scalar, high, jnp.inf),
        hard=tuple(name for name, task in tasks.items() if task.hard),
        limit_rows=limit_rows(robot, kinematics, q, limits, dt),
        dt=jnp.asarray(dt, lower.dtype),
        turning=robot.tree.turning,
        scalar=scalar,
    )


def _tick(dt: Any, q: Array) -> Any:
    """The tick in q's type, so that a Python number, a NumPy and a JAX one share a compiled program."""
    return dt.astype(q.dtype) if isinstance(dt, jax.Array) else np.asarray(dt, q.dtype)


def _checked(tasks: Any, robot: Robot) -> dict[str, Task]:
    check_tasks(tasks, robot)
    return dict(tasks)


def _own_scheme(q: Array, scheme: Scheme | None) -> Scheme:
    """The scheme that is given, or a weighted QP in the precision of q."""
    return jax.tree.map(lambda leaf: leaf.astype(q.dtype), WeightedQP()) if scheme is None else scheme


def _own_limits(robot: Robot, limits: tuple[Limit, ...] | None) -> tuple[Limit, ...]:
    """The limits that are given, or the robot's own."""
    return (ConfigurationLimit(robot), VelocityLimit(robot)) if limits is None else limits
