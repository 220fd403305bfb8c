"""Closed loop to tune: a robot, its tasks, a scheme and limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikValueError
from ..batching._names import leaf_names, replace_named
from ..batching._structure import is_number
from ..control import Trajectory, rollout
from ..control._checks import checked_limits
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
        ValueError: a task has the name of another part of the loop.
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
