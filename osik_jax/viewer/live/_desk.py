"""Session of a page (a controller whose parts can be switched off), its edits, and the loop that runs it."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ... import control
from ..._errors import OsikValueError, unknown_name
from ...limits import Limit, no_limits, with_own_limits
from ...robot import Robot
from ...saving._controller import controller_text
from ...saving._parts import decode, decode_parts, encode, encode_parts
from ...schemes import HierarchicalQP, NullSpace, Scheme, WeightedQP
from ...tasks import FrameTask, Task
from ._loop import ControlLoop
from ._obstacles import Obstacle, moved, obstacles_in
from ._step import Controller, targets_here, with_targets

_DAMPING = 1e-6
"""Damping of the hierarchical scheme. Without it joints oscillate where an obstacle blocks a task of high priority."""

SCHEMES: dict[str, Callable[[], Scheme]] = {
    "Weighted QP": WeightedQP,
    "Hierarchical QP": lambda: HierarchicalQP(damping=_DAMPING),
    "Null space": lambda: NullSpace(method="saturated"),
}
"""Schemes to choose from; all of them keep the limits."""


@dataclasses.dataclass(frozen=True)
class Session:
    """Tasks and limits of a live view, each of which can be switched off, with their robot and scheme.

    Attributes:
        robot: the robot.
        tasks: all tasks by name, switched off or not.
        scheme: how the tasks are combined: by weights or by priorities.
        limits: all limits, switched off or not: those given, then the robot's own that they do not replace.
        dt: time of a step [s].
        q: where the robot starts. (nq,)
        off: names of the tasks that are switched off.
        limits_off: numbers of the limits that are switched off, in the order of ``limits``.
        source: name or file of the robot, for files; None: a file has the robot itself.
    """

    robot: Robot
    tasks: Mapping[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]
    dt: float
    q: Float[np.ndarray, " nq"]
    off: frozenset[str] = frozenset()
    limits_off: frozenset[int] = frozenset()
    source: str | None = None

    def __post_init__(self) -> None:
        """Add the robot's own limits, so that they can be switched off too."""
        object.__setattr__(self, "limits", with_own_limits(self.robot, self.limits))

    @property
    def active_tasks(self) -> dict[str, Task]:
        """Return the tasks that are switched on."""
        return {name: task for name, task in self.tasks.items() if name not in self.off}

    @property
    def active_limits(self) -> tuple[Limit, ...]:
        """Return the limits that are switched on, in the form that ``solve`` takes."""
        on = tuple(limit for number, limit in enumerate(self.limits) if number not in self.limits_off)
        return (no_limits, *on) if self.limits_off else on

    def controller(self) -> Controller:
        """Return the controller of what is switched on."""
        return Controller(self.active_tasks, self.scheme, self.active_limits)

    def to_text(self) -> str:
        """Return the content of a controller's file; its robot is at home where this session starts."""
        robot = eqx.tree_at(lambda own: own.q0, self.robot, jnp.asarray(self.q, self.robot.q0.dtype))
        return controller_text(
            robot,
            self.active_tasks,
            scheme=self.scheme,
            limits=self.active_limits,
            dt=self.dt,
            source=self.source,
        )


class Desk:
    """Edits of a session, each passed on to the control loop.

    Attributes:
        loop: runs the session's controller.
    """

    def __init__(self, session: Session) -> None:
        """Take the initial session; the loop does not run yet."""
        self._session, self._lock = session, threading.RLock()
        self._seen: tuple[Any, dict[str, Obstacle]] = ((), {})
        controller = session.controller()
        self._told = (controller, session, session)
        self.loop = ControlLoop(session.robot, controller, dt=session.dt, q0=jnp.asarray(session.q))

    @property
    def session(self) -> Session:
        """Return the session with the current targets; the same object until something changes."""
        with self._lock:
            now = self.loop.controller
            if self._told[0] is now and self._told[1] is self._session:
                return self._told[2]
            targets = {k: t for k, task in now.tasks.items() if (t := getattr(task, "target", None)) is not None}
            tasks = with_targets(self._session.tasks, targets)
            self._told = now, self._session, dataclasses.replace(self._session, tasks=tasks)
            return self._told[2]

    def edit(self, **changes: Any) -> None:
        """Replace fields of the session."""
        with self._lock:
            new = dataclasses.replace(self.session, **changes)
            self.loop.change(lambda _: new.controller())
            self._session = new

    def switch(self, name: str, on: bool) -> None:
        """Switch a task on or off; its target starts at the robot's current pose."""
        with self._lock:
            session = self.session
            if on == (name not in session.off):
                return
            if on:
                here = targets_here(session.robot, self.loop.snapshot.q, session.tasks, [name])
                self._put(name, with_targets(session.tasks, here)[name], off=session.off - {name})
            elif len(session.active_tasks) == 1:
                raise OsikValueError("one task at least stays on")
            else:
                self.edit(off=session.off | {name})

    def renumber(self, name: str, **numbers: Any) -> None:
        """Set the weight or gain of a task."""
        with self._lock:
            self._put(name, self.task(name).replace(**numbers))

    def rank(self, name: str, priority: int) -> None:
        """Set the priority of a task."""
        with self._lock:
            task, robot = self.task(name), self._session.robot
            if task.priority != priority:
                self._put(name, decode({**encode(task, robot, name), "priority": priority}, robot, name))

    def add_frame(self, frame: str) -> str:
        """Add a task for a frame with its target at the current pose; return the task's name."""
        with self._lock:
            session, name = self.session, frame
            while name in session.tasks:
                name += "'"
            task = FrameTask(session.robot, frame, rows="position", weight=1e2, priority=3)
            self._put(name, task.at(session.robot, jnp.asarray(self.loop.snapshot.q)))
            return name

    def remove(self, name: str) -> None:
        """Remove a task; the last task cannot be removed."""
        with self._lock:
            left = {key: task for key, task in self.session.tasks.items() if key != name}
            if left:
                self.edit(tasks=left, off=self._session.off - {name})

    def take_scheme(self, title: str) -> None:
        """Set the scheme by its title."""
        self.edit(scheme=SCHEMES[title]())

    def switch_limit(self, number: int, on: bool) -> None:
        """Switch one of the session's limits on or off."""
        with self._lock:
            off = self._session.limits_off
            self.edit(limits_off=off - {number} if on else off | {number})

    @property
    def obstacles(self) -> dict[str, Obstacle]:
        """Return the obstacles by name."""
        with self._lock:
            if self._seen[0] is not self._session.limits:
                self._seen = self._session.limits, obstacles_in(self._session.limits)
            return self._seen[1]

    def move_obstacle(self, name: str, position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]) -> None:
        """Set position and rotation of an obstacle without compiling."""
        with self._lock:
            limits = moved(self._session.limits, name, position, rotation)
            self._session = dataclasses.replace(self._session, limits=limits)
            self.loop.place(name, position, rotation)

    def load(self, controller: control.Controller) -> None:
        """Replace the controller by one of the same robot, at the current configuration."""
        robot, tasks, scheme, limits, dt = controller
        own = self._session.robot
        if robot.tree.dof_owners != own.tree.dof_owners:
            raise OsikValueError("the controller is of another robot: start osik view with its file")
        if dt != self._session.dt:
            raise OsikValueError(f"the controller's step is {dt} s, this page's {self._session.dt} s")
        if robot.tree != own.tree:  # a file without source has frames in another order
            tasks, scheme, limits = decode_parts(encode_parts(robot, tasks, scheme, limits or ()), own)
        limits = with_own_limits(own, limits)
        self.edit(tasks=tasks, scheme=scheme, limits=limits, off=frozenset(), limits_off=frozenset())

    def task(self, name: str) -> Task:
        """Return a task by name."""
        tasks = self.session.tasks
        if name not in tasks:
            raise unknown_name("task", name, tuple(tasks))
        return tasks[name]

    def _put(self, name: str, task: Task, **changes: Any) -> None:
        self.edit(tasks={**self.session.tasks, name: task}, **changes)
