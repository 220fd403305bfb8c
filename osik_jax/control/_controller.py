"""A control loop in plain Python: the step of a robot, laid out once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from ..kinematics import integrate
from ..kinematics._manifold import plain_integration
from ..limits import Limit, Limits
from ..robot import Robot
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ._checks import (
    check_setting,
    check_target_names,
    check_tasks,
    checked_configuration,
    checked_limits,
    checked_start,
    plain_configuration,
    warn_of_idle_tasks,
    warn_of_ignored_priorities,
    warn_of_large_gains,
)
from ._plain_step import plain_step
from ._rollout import remembering
from ._solution import Solution
from ._step import Targets, Tasks, aim, in_type_of, step


class Controller:
    """Control step for loops in plain Python: NumPy in and out, one call of the core, nothing compiled by JAX.

    It computes what ``solve`` computes. Tasks, limits and schemes that the core does not have run in a compiled
    program, which takes seconds at the first step and more time at each.

    The numbers of a task may change: ``controller.tasks["hand"] = controller.tasks["hand"].replace(weight=2.0)``.
    A controller belongs to one thread at a time, and is not for use inside ``jit``: there is ``solve``.

    Args:
        robot: the robot.
        tasks: by name.
        scheme: as in ``solve``.
        limits: as in ``solve``. Limits and tasks that remember the last velocity get that of the step before.
        dt: time of a step [s].

    Attributes:
        robot: the robot.
        tasks: by name; a dict of the controller's own.
        scheme: how they share the robot.
        limits: the given ones, beside the robot's own.
        dt: time of a step [s].

    Raises:
        TypeError, ValueError: as in ``solve``.

    Warns:
        OsikWarning: as in ``solve``.
    """

    def __init__(
        self,
        robot: Robot,
        tasks: Tasks,
        *,
        scheme: Scheme | None = None,
        limits: Limits | None = None,
        dt: float = 0.005,
    ) -> None:
        check_setting("Controller(robot, tasks)", robot, scheme, dt)
        self.limits: tuple[Limit, ...] = checked_limits(robot, limits) or ()
        check_tasks(tasks, robot)
        warn_of_large_gains(tasks, dt)
        warn_of_ignored_priorities(scheme, tasks)
        warn_of_idle_tasks(robot, robot.q0, tasks, scheme)
        self.robot, self.tasks, self.dt = robot, dict(tasks), float(dt)
        self.scheme = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
        self._plain = plain_step(robot, self.tasks, self.scheme, self.limits, self.dt)
        self._velocity: Any = None
        self._checked: tuple[Any, Any] = None, None
        self._started = False

    def __iter__(self) -> Iterator[Any]:
        """Iterate over robot, tasks, scheme, limits and dt, the arguments of ``solve`` and ``rollout``."""
        return iter((self.robot, self.tasks, self.scheme, self.limits, self.dt))

    def step(self, q: Num[ArrayLike, " nq"] | Sequence[float], targets: Targets | None = None) -> Solution:
        """Return the solution of a step at q, with NumPy's arrays.

        Args:
            q: configuration. (nq,)
            targets: of some tasks in this step, by name, as in ``solve``; the others keep theirs.

        Raises:
            KeyError, TypeError, ValueError: as in ``solve``.
        """
        if targets:
            check_target_names(self.tasks, targets)
        if not self._started:
            checked_start(self.robot, q)
            self._started = True
        values = plain_configuration(self.robot, q)
        self._checked = q, values
        if self._plain is not None and values is not None:
            found = self._plain.solve(self.robot, values, self.tasks, self.scheme, self.limits, self.dt, targets or {})
            if found is None:  # another structure of tasks
                check_tasks(self.tasks, self.robot)
                self._plain = plain_step(self.robot, self.tasks, self.scheme, self.limits, self.dt)
                return self.step(q, targets)
            return self._plain.unpacked(*found)
        answer = self._compiled(checked_configuration(self.robot, q), targets)
        self._velocity = answer.velocity
        return jax.tree.map(np.asarray, answer)

    def integrate(
        self, q: Num[ArrayLike, " nq"] | Sequence[float], velocity: Num[ArrayLike, " nv"] | Sequence[float]
    ) -> Float[np.ndarray, " nq"]:
        """Return the configuration that is reached from q at this velocity in the time of a step, as ``integrate``.

        Raises:
            ValueError: q or the velocity has the wrong length, or q is not finite.
        """
        at, values = self._checked
        v = np.asarray(velocity)
        if at is not q:
            values = plain_configuration(self.robot, q)
        if self._plain is None or values is None or v.shape != (self.robot.nv,) or v.dtype != np.float64:
            return np.asarray(integrate(self.robot, q, velocity, self.dt))
        return plain_integration(self.robot.tree)(values, v * self.dt)

    def forget(self) -> None:
        """Forget the last velocity, as before the first step: limits and tasks that remember it begin anew."""
        self._velocity = None

    def _compiled(self, q: Array, targets: Targets | None) -> Solution:
        check_tasks(self.tasks, self.robot)
        todo = aim(dict(self.tasks), targets)
        todo, limits = remembering((todo, self.limits), self._velocity, True)
        return step(self.robot, q, todo, self.scheme, limits, in_type_of(self.dt, q))
