"""Closed loop to tune (a robot, its tasks, a scheme and limits), and the scenarios in which it is run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikKeyError, OsikTypeError, OsikValueError
from ..batching._names import find_leaves, leaf_names, replace_named
from ..batching._structure import is_number
from ..control import Trajectory, rollout
from ..control._checks import check_setting, check_steps, check_tasks, checked_limits
from ..control._step import Targets, Tasks
from ..limits import Limit, Limits, with_own_limits
from ..robot import Robot
from ..schemes import Scheme
from ..schemes._default import scheme_for

_PARTS = ("robot", "scheme", "limits", "dt")


class Loop(eqx.Module):
    """Arguments of ``osik_jax.rollout``, whose numbers can be tuned by name.

    Numbers of tasks are called ``hand.weight``, ``hand.gain`` or ``hand.gain.maximum``; the others ``scheme.damping``,
    ``limits[1].velocity``, ``robot.body_mass``, ``dt``. A name stands for all numbers under it, and ``*`` for any part
    of a name up to a dot. ``names`` has all of them.

    Attributes:
        robot: the robot.
        tasks: by name; or a function of time that returns them, of which an ``equinox.Module``'s fields have names.
        scheme: as in ``solve``.
        limits: hard bounds on the velocity, as in ``rollout``: those given, then the robot's own that they do not
            replace.
        dt: time of one step [s].
        steps: number of steps (static).

    Raises:
        TypeError, ValueError: as in ``rollout``; a task has the name of another part of the loop.
    """

    robot: Robot
    tasks: Tasks | Callable[[Array], Tasks]
    scheme: Scheme
    limits: tuple[Limit, ...]
    dt: Float[Array, ""]
    steps: int = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        tasks: Tasks | Callable[[Array], Tasks],
        *,
        scheme: Scheme | None = None,
        limits: Limits | None = None,
        dt: ArrayLike | Array = 0.005,
        steps: int,
    ):
        check_setting("Loop(robot, tasks)", robot, scheme, dt)
        check_steps(steps)
        if not callable(tasks):
            check_tasks(tasks, robot)
        self.robot, self.steps = robot, steps
        self.limits = with_own_limits(robot, checked_limits(robot, limits))
        self.tasks = tasks if callable(tasks) else dict(tasks)
        if scheme is None:
            at_start = self.tasks(jnp.zeros((), robot.q0.dtype)) if callable(self.tasks) else self.tasks
            scheme = scheme_for(at_start, robot.q0.dtype)
        self.scheme = scheme
        self.dt = jnp.asarray(dt, robot.q0.dtype)
        taken = [name for name in _PARTS if not callable(tasks) and name in tasks]
        if taken:
            raise OsikValueError(f"a task cannot be called {taken[0]!r}: that is another part of the loop; rename it")

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all numbers of the loop."""
        return tuple(name.removeprefix("tasks.") for name in leaf_names(eqx.filter(self, is_number)))

    def replace(self, values: Mapping[str, Any]) -> Self:
        """Return the loop with other numbers, by name: ``loop.replace({"hand.weight": 2.0})``.

        Signs are not checked.

        Raises:
            KeyError: no such name; the message lists those that exist.
            ValueError: a wrong shape, or a number that is given twice.
        """
        numbers, rest = eqx.partition(self, is_number)
        return eqx.combine(replace_named(numbers, self.names, values), rest)

    def rollout(self, q0: Float[Array, " nq"] | None = None, *, targets: Targets | None = None) -> Trajectory:
        """Return the loop run from a configuration (default: home), with targets by step as ``rollout`` takes."""
        return rollout(
            self.robot,
            self.robot.q0 if q0 is None else q0,
            self.tasks,
            scheme=self.scheme,
            limits=self.limits,
            dt=self.dt,
            steps=self.steps,
            targets=targets,
        )


class Scenarios(eqx.Module):
    """Batch of situations in which a loop is run; every array has a leading axis of scenarios.

    ``scenarios[:48]`` and ``scenarios[48:]`` are scenarios too, to train on and to hold out.

    Args:
        q0: where each begins. (n, nq); default: the robot's home.
        values: numbers of the loop that differ, by name as in ``Loop``: ``{"hand.target": (positions (n, 3), rotations
            (n, 3, 3)), "robot.body_mass": masses}``. (n,) numbers for an array: each is repeated.
        targets: targets that move, by task: what ``rollout`` takes as ``targets``, arrays of shape (n, steps, ...).

    Raises:
        ValueError: nothing is given, or lengths differ.
    """

    q0: Float[Array, "n nq"] | None
    values: dict[str, Any]
    targets: dict[str, Any]

    def __init__(
        self,
        *,
        q0: Any = None,
        values: Mapping[str, Any] | None = None,
        targets: Mapping[str, Any] | None = None,
    ):
        self.q0 = None if q0 is None else jnp.asarray(q0, float)
        self.values = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), dict(values or {}))
        self.targets = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), dict(targets or {}))
        lengths = {leaf.shape[:1] for leaf in jax.tree.leaves(self)}
        if len(lengths) != 1 or lengths & {(), (0,)}:
            found = ", ".join(str(n[0]) if n else "none" for n in sorted(lengths)) or "nothing is given"
            raise OsikValueError(f"scenarios are arrays with one leading axis of one length; lengths: {found}")

    def __len__(self) -> int:
        """Return the number of scenarios."""
        return jax.tree.leaves(self)[0].shape[0]

    def __getitem__(self, which: Any) -> Scenarios:
        """Return some scenarios: by a slice, or an array of indices or booleans."""
        if isinstance(which, int):
            raise OsikTypeError(f"scenarios are many: use [{which} : {which + 1}]")
        return jax.tree.map(lambda leaf: leaf[which], self)

    def fitted(self, loop: Loop) -> Scenarios:
        """Return the scenarios in the precision and shapes of a loop's numbers.

        Raises:
            KeyError: a name that the loop does not have.
            ValueError: a wrong shape, or a number that is given twice.
        """
        filled = replace_named(eqx.filter(loop, is_number), loop.names, self.values, batched=True)
        leaves = dict(zip(loop.names, jax.tree.leaves(filled), strict=True))
        places = [place for name in self.values for place in find_leaves(loop.names, name)]
        values = {loop.names[place]: leaves[loop.names[place]] for place in places}
        self._check_targets(loop)
        q0 = self.q0
        if q0 is not None:
            if q0.shape[1:] != (loop.robot.nq,):
                raise OsikValueError(f"q0 has shape {q0.shape}, expected (n, {loop.robot.nq})")
            q0 = q0.astype(loop.robot.q0.dtype)
        return eqx.tree_at(lambda s: (s.q0, s.values), self, (q0, values), is_leaf=lambda leaf: leaf is None)

    def _check_targets(self, loop: Loop) -> None:
        if callable(loop.tasks):
            if self.targets:
                raise OsikValueError("targets go with a dict of tasks; a function of time sets them itself")
            return
        for name, target in self.targets.items():
            if name not in loop.tasks:
                raise OsikKeyError(f"targets are for {name!r}, which is no task; tasks: {', '.join(loop.tasks)}")
            for leaf in jax.tree.leaves(target):
                if leaf.shape[1:2] != (loop.steps,):
                    raise OsikValueError(
                        f"targets[{name!r}] has shape {leaf.shape}; it is (n, {loop.steps}, ...), one target a step. "
                        f"For targets that stand still: values={{'{name}.target': ...}}"
                    )


def run_one(loop: Loop, scenario: Scenarios) -> tuple[Trajectory, Loop]:
    """Return one scenario (no leading axis): its trajectory, and the loop with its numbers."""
    own = loop.replace(scenario.values) if scenario.values else loop
    return own.rollout(scenario.q0, targets=scenario.targets or None), own
