"""Checks of a step's inputs before it is compiled and run; errors name what is wrong.

Nothing here runs inside a program: what is traced is looked at as far as its type and shape go.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._errors import OsikKeyError, OsikTypeError, OsikValueError, warn
from ..kinematics import forward_kinematics
from ..limits import Limit, NoLimits
from ..numerics._arguments import concrete
from ..numerics._host import float_now, is_traced
from ..robot import Robot
from ..robot._configuration import check_configuration
from ..robot._made_for import check_made_for, check_robot, check_single
from ..robot._ranges import warn_of_far_joints
from ..schemes import Scheme, SchemeAnswer, VelocityProblem, WeightedQP
from ..schemes._default import priorities
from ..tasks import Task, TaskRows
from ..tasks._rows import rows_of

LARGEST_GAIN = 2.0
"""Largest gain times dt that nothing is said of: an error e becomes (1 - gain dt) e in a step."""
_SPAN = 1e-3
"""Singular value of rows of length 1 below which they leave a direction free, and what then counts as 0."""
_SHORT = 1e-8
"""Squared length of a quaternion below which it is looked at again."""
_DEGREES = 6.5
"""Configurations without larger numbers are not looked at for degrees: those would be less than a turn in radians."""


def check_setting(where: str, robot: Any, scheme: Any, dt: Any) -> None:
    """Raise TypeError or ValueError for a wrong robot, scheme or dt."""
    check_robot(robot, where)
    _check_precision(robot)
    if scheme is not None and not isinstance(scheme, Scheme):
        raise OsikTypeError(f"scheme is {scheme!r}; it is a WeightedQP(), a NullSpace() or a HierarchicalQP()")
    if scheme is not None:
        check_single(scheme, "scheme")
    check_dt(dt)


def _check_precision(robot: Robot) -> None:
    """Raise ValueError for a float64 robot in single precision; warn of a float32 robot in double precision."""
    own, now = robot.q0.dtype, float_now()
    if own == now:
        return
    cure = "take robot.astype(float), or load it again, and make tasks, limits and scheme after that"
    if own == jnp.dtype("float64"):
        raise OsikValueError(f"the robot's numbers are float64, and jax_enable_x64 was switched off since: {cure}")
    warn(
        f"the robot's numbers are {own} while jax_enable_x64 is on: if it was made before that was switched on, {cure}"
    )


def checked_limits(robot: Robot, limits: Any) -> tuple[Limit, ...] | None:
    """Return the given limits as a tuple, or None; the robot's own limits are not added.

    Raises:
        TypeError: not a sequence of limits.
        ValueError: a limit was made for another robot.
    """
    if limits is None:
        return None
    if isinstance(limits, NoLimits):
        return (limits,)
    wanted = (
        "it is a sequence of limits beside the robot's own, such as (AccelerationLimit(robot, {'*': 5.0}),); "
        "osik_jax.no_limits: none at all"
    )
    if isinstance(limits, Limit | Mapping | str) or not hasattr(limits, "__iter__"):
        raise OsikTypeError(f"limits is {limits!r}; {wanted}")
    limits = tuple(limits)
    for place, limit in enumerate(limits):
        if not isinstance(limit, Limit):
            raise OsikTypeError(f"limits[{place}] is {limit!r}, which is no limit; {wanted}")
        check_made_for(limit, robot, f"limits[{place}]")
        check_single(limit, f"limits[{place}]")
    return limits


def check_dt(dt: Any) -> None:
    """Raise TypeError unless dt is a number, ValueError unless it is a scalar and, if concrete, positive and finite."""
    seen = concrete(dt)
    if seen is not None and seen.dtype.kind not in "iuf":
        raise OsikTypeError(f"dt is {dt!r}; it is a number, in seconds")
    if np.shape(dt) != ():
        raise OsikValueError(f"dt has shape {np.shape(dt)}; it is one number, in seconds. Batch with jax.vmap.")
    if seen is not None and not 0.0 < seen < np.inf:
        raise OsikValueError(f"dt is {dt}; it has to be positive and finite, in seconds")


def check_tasks(tasks: Any, robot: Robot | None = None) -> None:
    """Raise TypeError or ValueError unless these are tasks by name, made for this robot."""
    if not isinstance(tasks, Mapping):
        raise OsikTypeError(f"tasks is a {type(tasks).__name__}; it is a dict from names to tasks")
    if not tasks:
        raise OsikValueError("there is no task: give at least one, such as a PostureTask")
    for name, task in tasks.items():
        if not isinstance(name, str):
            raise OsikTypeError(f"{name!r} is the name of a task; names are strings: {', '.join(map(repr, tasks))}")
        if not isinstance(task, Task):
            shown = f"the class {task.__name__}" if isinstance(task, type) else f"a {type(task).__name__}"
            raise OsikTypeError(f"tasks[{name!r}] is {shown}, not a Task")
        check_single(task, f"tasks[{name!r}]")
        if robot is not None:
            check_made_for(task, robot, f"tasks[{name!r}]")


def checked_start(robot: Robot, q0: Any) -> Array:
    """Return a checked configuration to start from; warn of joints far outside their range."""
    q0 = checked_configuration(robot, q0)
    warn_of_far_joints(robot, q0, "q0")
    return q0


def warn_of_degrees(robot: Robot, q: Array | np.ndarray) -> None:
    """Warn of joint positions that look like degrees; cheaper than ``checked_start``, for use in each step."""
    seen = concrete(q)
    if seen is not None and np.abs(seen).max() > _DEGREES:
        warn_of_far_joints(robot, seen, "q")


def plain_configuration(robot: Robot, q: Any) -> np.ndarray | None:
    """Return a concrete q as ``checked_configuration``, in double precision; None if it is not of that kind.

    It warns of degrees too.
    """
    if isinstance(q, Tracer):
        return None
    values = np.asarray(q) if isinstance(q, jax.Array | np.ndarray) else None
    tree = robot.tree
    if values is None or values.dtype != np.float64 or values.shape != (tree.nq,):
        values = np.asarray(checked_configuration(robot, q))
    if not (
        np.abs(values).max() <= _DEGREES
        and all(values[a : a + 4] @ values[a : a + 4] > _SHORT for a in tree.quaternions)
    ):
        checked_configuration(robot, values)
        warn_of_degrees(robot, values)
    return values if values.dtype == np.float64 else None


def checked_configuration(robot: Robot, q: Any) -> Array:
    """Return a checked q as floats, at least as precise as the robot's.

    Raises:
        TypeError: q is not numeric.
        ValueError: a wrong length, not finite, or a quaternion of zeros.
    """
    try:
        q = jnp.asarray(q)
    except (TypeError, ValueError):
        raise OsikTypeError(f"q is {q!r}; it is a configuration: {robot.nq} numbers") from None
    check_configuration(robot, q, "q")
    return q.astype(jnp.result_type(q, robot.q0))


def warn_of_tasks(robot: Robot, q: Array, tasks: Mapping[str, Task], scheme: Scheme | None, dt: Any) -> None:
    """Warn of gains in other units, of priorities that a scheme ignores, and of tasks that do nothing at q."""
    warn_of_large_gains(tasks, dt)
    _warn_of_ignored_priorities(scheme, tasks)
    _warn_of_idle_tasks(robot, q, tasks, scheme)


_accepted_gains: tuple[Any, ...] = ()
"""dt and the gains that were looked at last, and are not too large: the next call with the same ones is quicker."""


def warn_of_large_gains(tasks: Mapping[str, Task], dt: Any) -> None:
    """Give one ``OsikWarning`` that names the tasks whose gain times dt is above 2; traced numbers are not checked.

    A step uses a gain of 1 / dt in their place (``Task.during``). Such large gains are mostly in other units.
    """
    global _accepted_gains
    gains = [getattr(task, "gain", 0.0) for task in tasks.values()]
    seen = (dt, *gains)
    if len(seen) == len(_accepted_gains) and all(map(operator.is_, seen, _accepted_gains)):
        return
    large = [float(getattr(gain, "maximum", gain)) for gain in gains if not is_traced(gain)]
    if is_traced(dt) or len(large) < len(gains):
        return
    named = [
        f"{name} (gain {gain:g})" for name, gain in zip(tasks, large, strict=True) if gain * float(dt) > LARGEST_GAIN
    ]
    if not named:
        _accepted_gains = seen
        return
    warn(
        f"gain times dt is above {LARGEST_GAIN:g}; a gain counts as 1 / dt at most in a step of {float(dt):g} s: "
        f"{', '.join(named)}. Gains are in 1/s, dt is in seconds"
    )


_said_ignored: set[tuple[tuple[str, int], ...]] = set()
"""Names and priorities of the sets of tasks that ``_warn_of_ignored_priorities`` has warned of."""


def _warn_of_ignored_priorities(scheme: Scheme | None, tasks: Mapping[str, Task]) -> None:
    """Warn, once for each set of tasks, if a ``WeightedQP`` is given and the priorities differ."""
    if not isinstance(scheme, WeightedQP) or len(priorities(tasks)) < 2:
        return
    named = tuple((name, task.priority) for name, task in tasks.items() if not task.hard)
    if named in _said_ignored:
        return
    _said_ignored.add(named)
    shown = ", ".join(f"{name} {priority}" for name, priority in named)
    warn(
        f"a WeightedQP ignores priorities ({shown}): only weights count. For strict priorities use HierarchicalQP() or "
        "leave scheme out; else give all tasks the same priority"
    )


_said_idle: set[tuple[Any, ...]] = set()
"""Sets of tasks that ``_warn_of_idle_tasks`` has looked at: whether priorities count, and each task's name and kind."""


def _warn_of_idle_tasks(robot: Robot, q: Array, tasks: Mapping[str, Task], scheme: Scheme | None) -> None:
    """Warn, once for each set of tasks, of calming tasks beneath tasks that leave their joints no freedom at q.

    The rank of the tasks above decides, not the number of their rows.
    """
    calming = [name for name, task in tasks.items() if task.calms and not task.hard]
    if not calming:
        return
    strict = not isinstance(scheme, WeightedQP)
    above = {
        name: [other for other, own in tasks.items() if own.hard or (strict and own.priority < tasks[name].priority)]
        for name in calming
    }
    if not any(above.values()) or is_traced((robot, q, tasks)):
        return
    named = strict, *((name, type(task).__name__, task.priority, task.hard) for name, task in tasks.items())
    if named in _said_idle:
        return
    _said_idle.add(named)
    # the call may stand inside a program that has these numbers as constants: a compiled one runs there too
    given = robot, q, dict(tasks)
    rows = {name: np.asarray(own) for name, own in _equality_rows.lower(*given).compile()(*given).items()}
    for name, others in above.items():
        first = [rows[other] for other in others if other in rows]
        if first and _span(np.concatenate(first), rows[name]):
            warn(
                f"the {type(tasks[name]).__name__} {name!r} does nothing: tasks that come first ({', '.join(others)}) "
                "fix its joints. Use motion.PoseFilter against noise, or a WeightedQP, where its weight counts"
            )


@jax.jit
def _equality_rows(robot: Robot, q: Array, tasks: dict[str, Task]) -> dict[str, Array]:
    """Return the Jacobians of the equality tasks, without rows of weight 0. {name: (m, nv)}."""
    rows = rows_of(robot, forward_kinematics(robot, q), q, tasks)
    return {name: (r.weight > 0.0)[:, None] * r.jacobian for name, r in rows.items() if r.is_equality}


def _span(above: np.ndarray, rows: np.ndarray) -> bool:
    """Return whether rows (m, nv) are combinations of the rows above (k, nv): no motion that keeps these moves them."""
    if not np.isfinite(above).all():
        return False
    lengths = np.linalg.norm(above, axis=1, keepdims=True)
    _, sizes, basis = np.linalg.svd(above / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    basis = basis[sizes > _SPAN * max(float(sizes.max(initial=0.0)), 1.0)]
    return bool(np.abs(rows - rows @ basis.T @ basis).max(initial=0.0) < _SPAN)


def check_steps(steps: Any) -> None:
    """Raise ValueError unless the number of steps is an integer from 0 up."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 0:
        raise OsikValueError(f"steps is {steps!r}; it is the number of steps, an integer")


def check_target_names(tasks: Mapping[str, Task], targets: Any, what: str = "targets") -> None:
    """Raise TypeError unless targets are a mapping, KeyError for a task that does not exist."""
    if targets is not None and not isinstance(targets, Mapping):
        raise OsikTypeError(f"targets is a {type(targets).__name__}; it is a dict from task names to {what}")
    for name in targets or {}:
        if name not in tasks:
            raise OsikKeyError(f"targets are for {name!r}, which is no task; tasks: {', '.join(tasks)}")


def check_targets(
    tasks: Mapping[str, Task] | Callable[[Array], Mapping[str, Task]],
    targets: Mapping[str, Any] | None,
    steps: int,
    robot: Robot | None = None,
) -> None:
    """Raise TypeError, ValueError or KeyError for invalid tasks, or for targets by step that do not fit them."""
    if callable(tasks):
        if targets is not None:
            raise OsikValueError("targets go with a dict of tasks; a function of time sets them itself")
        return
    check_tasks(tasks, robot)
    check_target_names(tasks, targets, "targets by step")
    for name, target in (targets or {}).items():
        parts = jax.tree.leaves(target, is_leaf=lambda part: isinstance(part, list))
        in_lists = jax.tree.leaves([part for part in parts if isinstance(part, list)])
        if any(isinstance(leaf, int | float) for leaf in in_lists):
            raise OsikTypeError(f"targets[{name!r}] is or holds a list of numbers; make it an array: jnp.asarray(list)")
        for leaf in jax.tree.leaves(target):
            if not eqx.is_array_like(leaf):
                raise OsikTypeError(
                    f"targets[{name!r}] holds objects of type {type(leaf).__name__}; it is made of arrays, such as "
                    "positions (steps, 3) and rotation matrices (steps, 3, 3) or quaternions (steps, 4)"
                )
            if jnp.shape(leaf)[:1] != (steps,):
                raise OsikValueError(
                    f"targets[{name!r}] has shape {jnp.shape(leaf)}; its first axis is the steps, {steps}"
                )


def check_warm_start(warm_start: Any) -> None:
    """Raise TypeError unless a warm start is made of integers; its shapes are checked when the step is compiled."""
    for leaf in jax.tree.leaves(warm_start):
        if not hasattr(leaf, "dtype") or not jnp.issubdtype(leaf.dtype, jnp.integer):
            raise OsikTypeError(
                f"warm_start is a {type(warm_start).__name__}; it is the warm_start of the step before's Solution"
            )


def solved_with(scheme: Scheme, problem: VelocityProblem, warm_start: Any) -> SchemeAnswer:
    """Return the scheme's answer; raise ValueError if the warm start is that of another problem or scheme.

    The expected shapes are those of an answer without warm start, which is traced only after an error.
    """
    if warm_start is None:
        return scheme.solve(problem)
    try:
        answer = scheme.solve(problem, warm_start)
    except Exception as error:
        expected = jax.eval_shape(lambda: scheme.solve(problem).warm_start)
        if _shapes(expected) == _shapes(warm_start):
            raise
        raise _other_warm_start(scheme, warm_start, expected) from error
    if _shapes(answer.warm_start) != _shapes(warm_start):
        raise _other_warm_start(scheme, warm_start, answer.warm_start)
    return answer


def _other_warm_start(scheme: Scheme, given: Any, expected: Any) -> ValueError:
    return OsikValueError(
        f"warm_start is that of another problem or scheme: it has arrays of shapes {_shapes(given)[1]}, and a "
        f"{type(scheme).__name__} with these tasks and limits takes {_shapes(expected)[1]}. Give the warm_start of a "
        "Solution with the same tasks, limits and scheme, or None"
    )


def _shapes(tree: Any) -> tuple[Any, list[tuple[int, ...]]]:
    return jax.tree.structure(tree), [jnp.shape(leaf) for leaf in jax.tree.leaves(tree)]


def check_rows(rows: Mapping[str, Any], tasks: Mapping[str, Task], robot: Robot) -> None:
    """Raise TypeError or ValueError if the rows of a task (perhaps a user's own) do not fit each other or the robot."""
    for name, own in rows.items():
        kind = type(tasks[name]).__name__
        if not isinstance(own, TaskRows):
            raise OsikTypeError(f"tasks[{name!r}]: {kind}.rows returned {own!r}; it returns TaskRows, see TaskRows.of")
        shapes = {field: jnp.shape(getattr(own, field)) for field in ("error", "lower", "upper", "weight")}
        count, jacobian = shapes["error"], jnp.shape(own.jacobian)
        if len(count) != 1 or any(shape != count for shape in shapes.values()) or jacobian != (*count, robot.nv):
            raise OsikValueError(
                f"tasks[{name!r}]: the rows of {kind} do not fit each other: jacobian has shape {jacobian}, expected "
                f"(m, {robot.nv}), and {', '.join(f'{field} {own}' for field, own in shapes.items())}, expected (m,)"
            )
