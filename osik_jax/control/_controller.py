"""A control loop in plain Python: the step of a robot, laid out once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, Float, Num

from .._errors import OsikTypeError
from ..kinematics import integrate
from ..kinematics._manifold import plain_integration
from ..limits import Limit, Limits
from ..numerics._host import is_traced
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
    warn_of_tasks,
)
from ._plain_step import Checked, plain_step
from ._rollout import remembering
from ._solution import Solution
from ._step import Targets, Tasks, aim, in_type_of, step

_TRACED = "a Controller is for numbers, not inside jit or vmap: there is osik_jax.solve"


class Controller:
    """Control step for loops in plain Python: NumPy in and out, one call of the core, nothing compiled by JAX.

    It computes what ``solve`` computes. Tasks, limits and schemes that the core does not have run in a compiled
    program, which takes seconds at the first step and more time at each.

    Tasks may be exchanged: ``controller.tasks["hand"] = controller.tasks["hand"].replace(weight=2.0)``. A controller
    belongs to one thread at a time, and is not for use inside ``jit``: there is ``solve``.

    Args:
        robot: the robot. Like all arguments it is an attribute too.
        tasks: by name; the attribute is a dict of the controller's own.
        scheme: as in ``solve``; the attribute is the one that is used.
        limits: as in ``solve``. Limits and tasks that remember the last velocity get that of the step before. The
            attribute has the given ones, beside the robot's own.
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
        check_tasks(tasks, robot)
        self.robot, self.tasks, self.dt = robot, dict(tasks), dt if is_traced(dt) else float(dt)
        self.limits: tuple[Limit, ...] = checked_limits(robot, limits) or ()
        self._velocity: Any = None
        self._started = False
        self.scheme = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
        self._chosen = self.scheme if scheme is None else None  # replaced where tasks want another one
        self._lay_out()

    def __iter__(self) -> Iterator[Any]:
        """Iterate over robot, tasks, scheme, limits and dt, the arguments of ``solve`` and ``rollout``."""
        return iter((self.robot, self.tasks, self.scheme, self.limits, self.dt))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has; it lays out its step itself."""
        return vars(self) | {"tasks": dict(self.tasks), "_plain": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy of a controller."""
        vars(self).update(state)
        self._lay_out()

    def step(self, q: Num[ArrayLike, " nq"] | Sequence[float], targets: Targets | None = None) -> Solution:
        """Return the solution of a step at q, with NumPy's arrays.

        Args:
            q: configuration. (nq,)
            targets: of some tasks in this step, by name, as in ``solve``; the others keep theirs.

        Raises:
            KeyError, TypeError, ValueError: as in ``solve``; TypeError also inside ``jit``.
        """
        if targets is not None:
            check_target_names(self.tasks, targets)
        if isinstance(q, Tracer) or (targets and is_traced(targets)):
            raise OsikTypeError(_TRACED)
        if not self._started:
            checked_start(self.robot, q)
            self._started = True
        if not self._checked.has_checked(self.robot, self.tasks, self.limits, self.dt):
            self._lay_out()
        values = plain_configuration(self.robot, q)
        if self._plain is not None and values is not None:
            found = self._plain.solve(self.robot, values, self.tasks, self.scheme, self.limits, self.dt, targets or {})
            if found is not None:
                self._velocity = found[0][: self.robot.nv]
                return self._plain.unpacked(*found)
            self._lay_out()  # of another scheme
        tasks = aim(dict(self.tasks), targets)
        tasks, limits = remembering((tasks, self.limits), self._velocity, True)
        at = checked_configuration(self.robot, q)
        answer = step(self.robot, at, tasks, self.scheme, limits, in_type_of(self.dt, at))
        self._velocity = answer.velocity
        return jax.tree.map(np.array, answer)

    def integrate(
        self, q: Num[ArrayLike, " nq"] | Sequence[float], velocity: Num[ArrayLike, " nv"] | Sequence[float]
    ) -> Float[np.ndarray, " nq"]:
        """Return the configuration that is reached from q at this velocity in the time of a step, as ``integrate``.

        Raises:
            ValueError: q or the velocity has the wrong length, or q is not finite.
        """
        at, v, tree = np.asarray(q), np.asarray(velocity), self.robot.tree
        if self._plain is not None and (at.shape, v.shape) == ((tree.nq,), (tree.nv,)) and at.dtype == v.dtype == float:
            found = plain_integration(tree)(at, v * self.dt)
            if found @ found < np.inf:
                return found
        return np.asarray(integrate(self.robot, q, velocity, self.dt))

    def forget(self) -> None:
        """Forget the last velocity, as before the first step: limits and tasks that remember it begin anew."""
        self._velocity = None

    def _lay_out(self) -> None:
        """Check the tasks, and lay out the step for the core where their structure is new."""
        check_setting("Controller", self.robot, self.scheme, self.dt)
        check_tasks(self.tasks, self.robot)
        self.limits = checked_limits(self.robot, self.limits) or ()
        if is_traced((self.robot, dict(self.tasks), self.scheme, self.limits, self.dt)):
            raise OsikTypeError(_TRACED)
        if self.scheme is None or self.scheme is self._chosen:
            chosen = scheme_for(self.tasks, self.robot.q0.dtype)
            self.scheme = self._chosen = self.scheme if type(chosen) is type(self.scheme) else chosen
        warn_of_tasks(self.robot, self.robot.q0, self.tasks, self.scheme, self.dt)
        plain = getattr(self, "_plain", None)
        given = self.robot, self.tasks, self.scheme, self.limits
        known = plain is not None and plain.is_of(*given)
        self._plain = plain if known else plain_step(*given, self.dt)
        self._checked = Checked(*given)
