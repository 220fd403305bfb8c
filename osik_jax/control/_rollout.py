"""Many control steps: the closed loop in one compiled scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from .._errors import OsikValueError
from ..batching._structure import Static, put_together, taken_apart
from ..execution._memory_maps import watch_memory_maps
from ..execution._rules import FOUND
from ..kinematics import integrate
from ..limits import Limit, Limits
from ..numerics._placeholder import with_placeholder
from ..robot import Robot
from ..schemes import Scheme
from ..tasks import Task
from ._checks import (
    check_setting,
    check_steps,
    check_targets,
    check_tasks,
    checked_configuration,
    checked_limits,
    checked_start,
    warn_of_tasks,
)
from ._solution import Solution, Trajectory
from ._step import Targets, Tasks, aim, in_type_of, step

Feedback = Callable[[Array, Array], Array]
_Carry = tuple[Array, Any, Any]
"""State passed from step to step: configuration, velocity and warm start."""


def rollout(
    robot: Robot,
    q0: Num[ArrayLike, " nq"] | Sequence[float],
    tasks: Tasks | Callable[[Array], Tasks],
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: Float[Array, ""] | float = 0.005,
    steps: int,
    targets: Targets | None = None,
    feedback: Feedback | Float[ArrayLike, "steps nq"] | None = None,
) -> Trajectory:
    """Return the closed loop: solve, integrate, repeat, in one compiled scan.

    Differentiable in both modes. The reverse mode keeps the configuration and the solver's answer of each step, and
    computes everything else again: a long path costs little memory.

    Args:
        robot: the robot.
        q0: start. (nq,)
        tasks: by name, or a function from time [s] to tasks (the same ones each time, with other numbers). A function
            that is a pytree, such as an ``equinox.Module`` with ``__call__``, may change its numbers (arrays and
            floats; integers are static) without compiling; any other function compiles once for each object.
        scheme: as in ``solve``.
        limits: as in ``solve``. Limits and tasks that remember the last velocity get it at each step; the
            first takes them as they are.
        dt: time of one step [s].
        steps: number of steps (static).
        targets: targets of some tasks at each step, by task name: what ``replace(target=...)`` takes, with a leading
            axis of length ``steps`` on every array.
        feedback: measured configurations: an array with one for each step (steps, nq), or a function of time [s] and of
            the configuration that the last step led to, which returns the one measured. Default: no feedback. The
            trajectory holds where the steps led, not what was measured.

    Returns:
        The trajectory. Every step applies its velocity, whatever the status (``Solution.velocity`` says what it is);
        one that failed on a NaN in q or dt moves nothing: look at ``solution.status``.

    Raises:
        TypeError, ValueError: as in ``solve``; ``targets``, ``feedback`` or ``steps`` do not fit.
        KeyError: ``targets`` names a task that does not exist.

    Warns:
        OsikWarning: as in ``solve``.
    """
    check_setting("rollout(robot, q0, tasks)", robot, scheme, dt)
    limits = checked_limits(robot, limits)
    check_steps(steps)
    check_targets(tasks, targets, steps, robot)
    if feedback is not None and not callable(feedback):
        feedback = jnp.asarray(feedback)
        if feedback.shape != (steps, robot.nq):
            raise OsikValueError(
                f"feedback has shape {feedback.shape}; it is one configuration a step, {(steps, robot.nq)}"
            )
    numbers, static = taken_apart((tasks if callable(tasks) else dict(tasks), feedback))
    q0 = checked_start(robot, q0)
    if not callable(tasks):
        warn_of_tasks(robot, q0, tasks, scheme, dt)
    path = _rollout(robot, q0, numbers, scheme, limits, in_type_of(dt, q0), targets, static=static, steps=steps)
    watch_memory_maps("rollout", _rollout)
    return path


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

    def one_step(
        state: _Carry, now: tuple[Array, Targets | None, Array | None]
    ) -> tuple[_Carry, tuple[Array, Solution]]:
        (q, velocity, warm_start), (t, target, sensed) = state, now
        if callable(feedback):
            q = checked_configuration(robot, feedback(t, q))
        elif sensed is not None:
            q = sensed.astype(q.dtype)
        todo = _checked(tasks(t), robot) if callable(tasks) else aim(tasks, target)
        todo, kept = remembering((todo, limits), velocity, t > 0.0)
        solution = step(robot, q, todo, scheme, kept, dt, warm_start)
        q = move(robot, q, solution.velocity, dt)
        return (q, solution.velocity, solution.warm_start), (q, solution)

    inputs = (time, targets, measured)
    cold = _cold_start(lambda now: one_step((q0, None, None), now)[0][1:], inputs)
    thrifty = jax.checkpoint(one_step, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(FOUND))
    _, (q, solution) = jax.lax.scan(thrifty, (q0, *cold), inputs, length=steps)
    return Trajectory(time, jnp.concatenate([q0[None], q]), solution)


def remembering(tasks_and_limits: Any, velocity: Float[Array, " nv"] | None, moved: Bool[Array, ""] | bool) -> Any:
    """Return tasks and limits ``after`` a step's velocity, or unchanged before the first step (``moved`` false)."""

    def one(part: Task | Limit) -> Task | Limit:
        if velocity is None or type(part).after in (Task.after, Limit.after):
            return part
        return jax.tree.map(lambda new, old: jnp.where(moved, new, old), part.after(velocity), part)

    return jax.tree.map(one, tasks_and_limits, is_leaf=lambda part: isinstance(part, Task | Limit))


def move(robot: Robot, q: Array, v: Array, dt: Array | float) -> Array:
    """Return the configuration after a step; q itself if q or dt is NaN."""
    (usable, usable_dt), is_valid = with_placeholder((q, jnp.asarray(dt)))
    return jnp.where(is_valid, integrate(robot, usable, v, usable_dt).astype(q.dtype), q)


def _cold_start(one_step: Callable[[Any], Any], inputs: Any) -> Any:
    """Return zeros in the shapes of the state that a step passes on, found by tracing one step."""
    one = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), jax.tree.map(jnp.asarray, inputs))
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(one_step, one))


def _checked(tasks: Any, robot: Robot) -> dict[str, Task]:
    check_tasks(tasks, robot)
    return dict(tasks)
