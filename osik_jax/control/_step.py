"""One control step: from a configuration and tasks to a velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from ..execution._blocks import BLOCK
from ..execution._memory_maps import watch_memory_maps
from ..execution._rules import blocked
from ..kinematics import Kinematics, forward_kinematics
from ..kinematics._forward import kinematics_by
from ..limits import ConfigurationLimit, Limit, Limits, limit_box, limit_rows, with_own_limits
from ..numerics._guarded import greatest
from ..numerics._placeholder import positive, with_placeholder
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..schemes import Scheme, VelocityProblem
from ..schemes._default import scheme_for
from ..solvers import Status
from ..tasks import Task
from ..tasks._rows import rows_of
from ._checks import (
    check_rows,
    check_setting,
    check_target_names,
    check_tasks,
    check_warm_start,
    checked_configuration,
    checked_limits,
    solved_with,
    warn_of_degrees,
    warn_of_tasks,
)
from ._compiled_step import compiled, is_compiled
from ._plain_step import PlainStep, keep_step, kept_step
from ._solution import Solution

Tasks = Mapping[str, Task]
Targets = Mapping[str, Any]


def solve(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks,
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: Float[Array, ""] | float = 0.005,
    targets: Targets | None = None,
    warm_start: Any = None,
) -> Solution:
    """Return the velocity that serves the tasks best at configuration q.

    Compiled on first use; changing any number (target, weight, gain, limit, dt, link length) compiles nothing. Pure, so
    it can be used inside ``jit`` and batched by ``vmap`` over q and over any leaf of robot, tasks, scheme and limits.

    Args:
        robot: the robot.
        q: configuration. (nq,)
        tasks: by name; the names come back in ``slack`` and ``error``.
        scheme: ``WeightedQP()``, ``NullSpace()`` or ``HierarchicalQP()``. Default: ``HierarchicalQP()`` where the
            priorities of the tasks differ, ``WeightedQP()`` where they are all the same.
        limits: hard bounds on the velocity beside the robot's own, ``ConfigurationLimit(robot)`` and
            ``VelocityLimit(robot)``. A given limit of one of these two classes replaces the robot's own;
            ``osik_jax.no_limits``, alone or in the sequence, switches both off. Limits that remember the last step's
            velocity, such as ``AccelerationLimit``, need it each time: ``limit.after(solution.velocity)``.
        dt: time until the next step [s].
        targets: of some tasks, by name: what ``task.replace(target=...)`` takes, such as a pose as (position, rotation
            matrix), (position, quaternion w x y z), a 4 x 4 matrix or a ``jaxlie.SE3``. The other tasks keep theirs.
        warm_start: that of the step before (``Solution.warm_start``), with the same tasks, scheme and limits. It saves
            time and does not change the answer; one with wrong numbers costs time only.

    Returns:
        The answer. What can be known of numbers only when they are there, such as a traced dt <= 0, raises nothing:
        look at ``status``, or call ``osik_jax.raise_if_failed`` outside jit.

    Raises:
        KeyError: ``targets`` names a task that does not exist.
        TypeError: something that is no robot, task, scheme or limit, or no number.
        ValueError: q of the wrong length, not finite or with a quaternion of zeros; no task; dt <= 0; a task or limit
            that was made for another robot, the warm start of another problem; a robot that is a stack, or that has
            float64 numbers while ``jax_enable_x64`` is off.

    Warns:
        OsikWarning: a robot that has float32 numbers while ``jax_enable_x64`` is on; numbers that are probably in other
            units: a joint far outside its range, or a gain times dt above 2; once for each set of tasks, priorities
            that differ while ``scheme`` is a ``WeightedQP``, which ignores them, and a ``LowAccelerationTask`` or
            ``DampingTask`` beneath tasks that leave its joints no freedom.
    """
    plain = kept_step(robot, tasks, scheme, limits)
    if plain is None or not plain.has_checked(robot, tasks, limits, dt):
        check_setting("solve(robot, q, tasks)", robot, scheme, dt)
        limits = checked_limits(robot, limits)
        check_tasks(tasks, robot)
        warn_of_tasks(robot, checked_configuration(robot, q), tasks, scheme, dt)
        plain = kept_step(robot, tasks, scheme, limits)
        if plain is None or (isinstance(plain, PlainStep) and not plain.fits(tasks)):
            plain = keep_step(robot, q, tasks, scheme, limits, dt)
        elif not isinstance(plain, PlainStep):
            plain.note(robot, tasks, limits)
    check_target_names(tasks, targets)
    check_warm_start(warm_start)
    if isinstance(plain, PlainStep):
        found = plain.solution(robot, q, tasks, scheme, limits, dt, targets, warm_start)
        if found is not None:
            return found
    q = checked_configuration(robot, q)
    warn_of_degrees(robot, q)
    aimed, bounds = aim(dict(tasks), targets), checked_limits(robot, limits)
    solution = step(robot, q, aimed, scheme, bounds, in_type_of(dt, q), warm_start)
    watch_memory_maps("solve", step)
    return solution


def build_problem(
    robot: Robot,
    q: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks,
    *,
    limits: Limits | None = None,
    dt: Float[Array, ""] | float = 0.005,
    targets: Targets | None = None,
    kinematics: Kinematics | None = None,
) -> VelocityProblem:
    """Return what ``solve`` hands to its scheme: the rows of the tasks, the box and the rows of the limits, assembled.

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
        kinematics: at q. Default: ``forward_kinematics(robot, q)``.

    Raises:
        KeyError, TypeError, ValueError: as in ``solve``.
    """
    check_setting("build_problem(robot, q, tasks)", robot, None, dt)
    bounds = with_own_limits(robot, checked_limits(robot, limits))
    check_tasks(tasks, robot)
    check_target_names(tasks, targets)
    q = checked_configuration(robot, q)
    aimed = aim(dict(tasks), targets)
    if kinematics is None:
        kinematics = forward_kinematics(robot, q)
    return velocity_problem(robot, kinematics, q, aimed, bounds, in_type_of(dt, q))


@jax.jit
def step(
    robot: Robot,
    q: Array,
    tasks: dict[str, Task],
    scheme: Scheme | None,
    limits: tuple[Limit, ...] | None,
    dt: Array | float,
    warm_start: Any = None,
) -> Solution:
    chosen = scheme_for(tasks, q.dtype) if scheme is None else scheme
    given = robot, q, tasks, chosen, with_own_limits(robot, limits), dt, warm_start
    return (_compiled_step if is_compiled(*given) else _plain_step)(*given)


@jax.jit
@blocked(BLOCK)
def _plain_step(
    robot: Robot,
    q: Array,
    tasks: dict[str, Task],
    chosen: Scheme,
    bounds: tuple[Limit, ...],
    dt: Array | float,
    warm_start: Any,
) -> Solution:
    """Return the step's solution from its parts, one after another: the definition."""
    dt = positive(dt)
    raw_box = jax.lax.stop_gradient(limit_box(robot, q, bounds, dt))
    (robot, q), is_valid_pose = with_placeholder((robot, q))
    (chosen, bounds, dt), set_up = with_placeholder((chosen, bounds, dt))
    looked_at = {name: with_placeholder(task) for name, task in tasks.items()}
    tasks, is_valid = (
        {k: task for k, (task, _) in looked_at.items()},
        {k: is_valid_pose & own for k, (_, own) in looked_at.items()},
    )
    kinematics = kinematics_by(getattr(chosen, "backend", "jax"), robot, q)
    problem = velocity_problem(robot, kinematics, q, tasks, bounds, dt)
    given = _with_nan(problem, raw_box, jnp.stack([set_up, *is_valid.values(), _damping_is_finite(problem)]).all())
    answer = solved_with(chosen, given, warm_start)
    v = answer.velocity
    failed = answer.status == Status.NUMERICAL_ERROR
    return Solution(
        velocity=v,
        status=answer.status,
        iterations=answer.iterations,
        factorizations=answer.factorizations,
        kkt_residual=jnp.where(failed, jnp.finfo(v.dtype).max, answer.kkt_residual),
        box_violation=greatest(_finite(_beyond_limits(given, v))),
        slack={name: _finite(jnp.where(is_valid[name], slack, 0.0)) for name, slack in problem.slack(v).items()},
        error={name: _finite(jnp.where(is_valid[name], rows.error, 0.0)) for name, rows in problem.rows.items()},
        warm_start=answer.warm_start,
    )


_compiled_step = compiled(_plain_step)


def _damping_is_finite(problem: VelocityProblem) -> Array:
    """Return whether the numbers by which schemes choose the damping are finite; solvers check all other numbers."""
    fields = ("error", "weight", "pull", "levers", "curvature")
    numbers = [jnp.ravel(getattr(rows, field)) for rows in problem.rows.values() for field in fields]
    return jnp.isfinite(jax.lax.stop_gradient(jnp.concatenate(numbers))).all()


def _with_nan(problem: VelocityProblem, raw_box: tuple[Array, Array], is_valid: Array) -> VelocityProblem:
    """Re-insert NaN where inputs were not valid, so that every solver reports NUMERICAL_ERROR.

    A select inserts it, so that derivatives by the problem's data are 0 in that lane. In equality rows the wanted
    velocities and weights become NaN, in one operation for all tasks, because matrices are large.
    """
    small = [name for name, r in problem.rows.items() if r.is_equality and r.dofs is None and name not in problem.hard]
    rows = {
        name: replace(
            r, jacobian=jnp.where(is_valid, r.jacobian, jnp.nan), weight=jnp.where(is_valid, r.weight, jnp.nan)
        )
        for name, r in problem.rows.items()
        if name not in small
    }
    if small:
        numbers = [getattr(problem.rows[name], field) for field in ("lower", "weight") for name in small]
        ends = np.cumsum([len(a) for a in numbers])[:-1]
        with_nan = jnp.split(jnp.where(is_valid, jnp.concatenate(numbers), jnp.nan), ends)
        for name, wanted, weight in zip(small, with_nan, with_nan[len(small) :], strict=False):
            rows[name] = replace(problem.rows[name], lower=wanted, upper=wanted, weight=weight)
        rows = {name: rows[name] for name in problem.rows}
    lower, upper = (
        jnp.where(jnp.isnan(raw), raw, b) for raw, b in zip(raw_box, (problem.lower, problem.upper), strict=True)
    )
    return replace(problem, rows=rows, lower=lower, upper=upper)


def _beyond_limits(problem: VelocityProblem, v: Float[Array, " nv"]) -> Float[Array, " m"]:
    """Return how far v leaves its box, then its rows."""
    box = jnp.maximum(jnp.maximum(problem.lower - v, v - problem.upper), 0.0)
    return box if problem.limit_rows is None else jnp.concatenate([box, problem.limit_rows.violation(v)])


def _finite(x: Array) -> Array:
    return jnp.where(jnp.isfinite(x), x, 0.0)


def aim(tasks: dict[str, Task], targets: Targets | None) -> dict[str, Task]:
    """Return the tasks with this step's targets."""
    aimed = {name: tasks[name].replace(target=target) for name, target in (targets or {}).items()}
    return {**tasks, **aimed}


def velocity_problem(
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


def in_type_of(dt: Any, q: Array) -> Any:
    """Return dt in q's dtype, so that numbers of Python, NumPy and JAX share a compiled program."""
    return dt.astype(q.dtype) if isinstance(dt, jax.Array) else np.asarray(dt, q.dtype)
