"""Control loop in its own thread; requests take effect between steps and never block it."""

from __future__ import annotations

import atexit
import gc
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Array, Float

from ... import control
from ..._errors import OsikValueError, unknown_name
from ...robot import Robot
from ...solvers import Status
from ._obstacles import moved
from ._step import Controller, laid_out, targets_here, with_targets

_LATE = 5
"""Number of periods of delay after which a loop restarts its schedule instead of catching up."""
_SWITCH_INTERVAL = 5e-5
"""GIL switch interval while a loop runs [s]."""
_HALF_A_MICROSECOND = 5e-7
"""Offset [s] added to the switch interval, which Python truncates to whole microseconds."""
_loops: set[int] = set()
"""Identities of the running loops. The last one to stop unfreezes the objects of Python's garbage collector."""
CONTROL, DRAWING = -10, 5
"""Niceness of the control and drawing threads; other threads have 0."""


@dataclass(frozen=True)
class Timing:
    """Percentiles over the last steps of a loop.

    Attributes:
        steps: number of steps since the start or the last pause.
        period: time from one start to the next: median, 99th percentile and longest [s].
        step: time spent computing a step: median, 99th percentile and longest [s].
    """

    steps: int
    period: tuple[float, float, float]
    step: tuple[float, float, float]


class Stopwatch:
    """Start times and durations of the last steps."""

    def __init__(self, length: int = 2000) -> None:
        """Take the number of steps to keep."""
        self._steps, self._count = deque[tuple[float, float]](maxlen=length), 0

    def add(self, start: float, duration: float) -> None:
        """Record a step [s]."""
        self._steps.append((start, duration))
        self._count += 1

    def clear(self) -> None:
        """Discard all steps, as after a pause."""
        self._steps.clear()
        self._count = 0

    def timing(self) -> Timing:
        """Return percentiles of the recorded steps."""
        starts, durations = np.array(self._steps.copy()).reshape(-1, 2).T
        return Timing(self._count, _percentiles(np.diff(starts)), _percentiles(durations))


@dataclass(frozen=True)
class Snapshot:
    """State after the last step.

    Attributes:
        time: simulated since the start or the last reset [s].
        q: configuration. (nq,)
        velocity: what the controller asked for. (nv,)
        status: a ``Status`` code.
        errors: of each task. {name: (m,)}
        failures: steps since the start or the last reset whose answer could not be used: the robot stood still.
        ready: whether a compiled step runs; before that, the robot stands still.
        preparing: whether what was asked for is still being compiled.
        paused: whether the robot stands still because it was asked to.
        problem: why the last change could not be compiled; empty where it could.
    """

    time: float
    q: Float[np.ndarray, " nq"]
    velocity: Float[np.ndarray, " nv"]
    status: int = int(Status.SOLVED)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    failures: int = 0
    ready: bool = False
    preparing: bool = False
    paused: bool = False
    problem: str = ""


class ControlLoop:
    """Controller running at a fixed rate in its own thread.

    All methods may be called from any thread, and take effect in the next step. The first step of another structure
    (another task, scheme, priority or limit) takes some milliseconds, or the seconds of a compilation where the core
    does not have it; the robot stands still meanwhile, as while paused and after an answer that is not finite. If the
    owner of a target (``aim``) leaves, the target becomes the robot's current pose.

    Attributes:
        robot: the robot.
        dt: the period [s].
    """

    def __init__(
        self, robot: Robot, controller: Controller, *, dt: float = 0.005, q0: Float[Array, " nq"] | None = None
    ) -> None:
        """Take the robot, the first controller, the period [s] and the start configuration (default ``robot.q0``).

        Raises:
            ValueError: q0 does not fit, or dt is not positive.
        """
        if not (np.isfinite(dt) and dt > 0.0):
            raise OsikValueError(f"dt is {dt}; it has to be positive and finite, in seconds")
        start = robot.q0 if q0 is None else q0
        robot.check_configuration(start, "q0")
        self.robot, self.dt = robot, float(dt)
        self._start = np.asarray(start, robot.q0.dtype)
        still = np.zeros(robot.nv, self._start.dtype)
        self._lock = threading.RLock()
        self._wanted: Controller = controller
        self._laid: Controller | None = None
        self._refused: Controller | None = None
        self._stepper: control.Controller | None = None
        self._owners: dict[str, Hashable] = {}  # of targets, by task
        self._problem = ""
        self._orders: deque[Callable[[], None]] = deque()
        self._stopwatch = Stopwatch()
        self._snapshot = Snapshot(0.0, self._start, still, preparing=True)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="osik-control", daemon=True)

    def start(self) -> Self:
        """Start the thread.

        While it runs, the GIL switch interval is 0.05 ms (default 5 ms): the control thread may wait that long for each
        other thread that computes. Garbage collection skips the objects that exist when a step is laid out.
        """
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(_SWITCH_INTERVAL, self._switch_interval))
        _loops.add(id(self))
        # a thread that is inside XLA when Python ends may crash the process
        atexit.register(self.stop)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread, after the current step: no thread may be inside XLA when Python ends."""
        atexit.unregister(self.stop)
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
            sys.setswitchinterval(self._switch_interval + _HALF_A_MICROSECOND)
            _loops.discard(id(self))
            if not _loops:
                gc.unfreeze()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def snapshot(self) -> Snapshot:
        """Return the state after the last step; a new object for each step."""
        return self._snapshot

    @property
    def controller(self) -> Controller:
        """Return the requested controller, which runs from the next step on; the same object until it changes."""
        return self._wanted

    @property
    def timing(self) -> Timing:
        """Return periods and step times of the last steps since the start or the last pause."""
        return self._stopwatch.timing()

    def wait_until_ready(self, timeout: float = 60.0) -> bool:
        """Wait until the requested controller runs; return False if it does not within the timeout [s]."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            laid, wanted = self._laid, self._wanted
            if laid is not None and (laid is wanted or laid.structure() == wanted.structure()):
                return True
            time.sleep(0.005)
        return False

    def change(self, edit: Callable[[Controller], Controller]) -> None:
        """Replace the requested controller by ``edit(controller)``; concurrent changes run one after another.

        Raises:
            Whatever ``edit`` raises; the controller then stays.
        """
        with self._lock:
            self._wanted, self._problem = edit(self._wanted), ""

    def aim(self, name: str, target: Any, *, owner: Hashable = None) -> None:
        """Set the target of a task.

        Args:
            name: of the task.
            target: what ``task.replace(target=...)`` takes.
            owner: who leads it; ``release(owner)`` holds the robot where it is.

        Raises:
            KeyError: no such task.
            TypeError, ValueError: no such target.
        """
        if name not in self._wanted.tasks:
            raise unknown_name("task", name, tuple(self._wanted.tasks))
        task: Any = self._wanted.tasks[name]
        new = task.replace(target=target).target
        with self._lock:
            self._owners[name] = owner
            self._wanted = self._aimed({name: new})

    def place(self, obstacle: str, position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]) -> None:
        """Set position and rotation of an obstacle."""
        with self._lock:
            self._wanted = replace(self._wanted, limits=moved(self._wanted.limits, obstacle, position, rotation))

    def let_go(self, owner: Hashable) -> None:
        """Keep the targets where their owner left them."""
        with self._lock:
            self._owners = {name: other for name, other in self._owners.items() if other != owner}

    def release(self, owner: Hashable) -> None:
        """Set the targets of an owner who left to the robot's current pose."""
        with self._lock:
            left = [name for name, other in self._owners.items() if other == owner]
        if left:
            self._orders.append(lambda: self._hold(left))

    def pause(self) -> None:
        """Stop the robot from the next step on."""
        self._orders.append(lambda: self._show(paused=True))

    def resume(self) -> None:
        """Resume after a pause."""
        self._orders.append(lambda: self._show(paused=False))

    def reset(self) -> None:
        """Move the robot to its start configuration at once; targets stay."""
        self._orders.append(self._reset)

    def _run(self) -> None:
        """Run the control thread."""
        be_nice(CONTROL)
        deadline = time.perf_counter()
        while not self._stop.is_set():
            self._run_once()
            # counted from the schedule and not from now, so that delays do not add up
            deadline += self.dt
            wait = deadline - time.perf_counter()
            if wait > 0.0:
                time.sleep(wait)
            elif wait < -_LATE * self.dt:
                deadline = time.perf_counter()

    def _run_once(self) -> None:
        begin = time.perf_counter()
        while self._orders:
            self._orders.popleft()()
        self._lay_out()
        self._show(problem=self._problem)
        if self._stepper is None or self._snapshot.paused:
            # periods across a pause would count as late
            self._stopwatch.clear()
            return
        try:
            self._step(self._stepper)
        except Exception as error:  # numbers that a step refuses, such as a gain that is too large for its time
            self._problem = " ".join(str(error).split())
            self._show(velocity=np.zeros_like(self._snapshot.velocity), failures=self._snapshot.failures + 1)
        self._stopwatch.add(begin, time.perf_counter() - begin)

    def _lay_out(self) -> None:
        """Take the requested controller; return to the one that runs, and tell why, if its step raises."""
        wanted, laid = self._wanted, self._laid
        if wanted is laid or wanted is self._refused:
            return
        own = self._stepper
        if laid is not None and own is not None and wanted.structure() == laid.structure():
            own.tasks, own.scheme, own.limits = dict(wanted.tasks), wanted.scheme, wanted.limits
            self._laid = wanted
            return
        self._show(preparing=True)
        try:
            step = laid_out(self.robot, wanted, self.dt)
            step.step(self._snapshot.q)  # compiles what is not the core's, and raises what a task of one's own raises
            step.forget()
        except Exception as error:
            with self._lock:
                self._refused, self._problem = wanted, " ".join(str(error).split())
                if laid is not None and self._wanted is wanted:
                    self._wanted = laid
            self._show(preparing=laid is None)
            return
        self._laid, self._stepper = wanted, step
        targets_here(self.robot, self._snapshot.q, wanted.tasks, wanted.tasks)  # compiled now, so that no step waits
        # a collection over all of JAX's objects takes up to 0.1 s, several periods of the loop
        gc.freeze()
        self._show(ready=True, preparing=False)

    def _step(self, own: control.Controller) -> None:
        """Run one step; the robot stands still where the answer is unusable."""
        before = self._snapshot
        found = own.step(before.q)
        q, status = own.integrate(before.q, found.velocity), int(found.status)
        usable = bool(np.isfinite(q).all()) and status != Status.NUMERICAL_ERROR
        if not usable:
            own.forget()
        self._show(
            time=before.time + self.dt,
            q=q if usable else before.q,
            velocity=found.velocity if usable else np.zeros_like(before.velocity),
            status=status,
            errors=found.error,
            failures=before.failures + (not usable),
        )

    def _show(self, **changes: Any) -> None:
        self._snapshot = replace(self._snapshot, **changes)

    def _reset(self) -> None:
        """Move the robot to the start, at rest."""
        if self._stepper is not None:
            self._stepper.forget()
        self._show(time=0.0, q=self._start, velocity=np.zeros_like(self._snapshot.velocity), failures=0)

    def _hold(self, names: list[str]) -> None:
        """Set the targets of these tasks to the robot's current pose."""
        here = targets_here(self.robot, self._snapshot.q, self._wanted.tasks, names)
        with self._lock:
            self._owners = {name: other for name, other in self._owners.items() if name not in names}
            self._wanted = self._aimed(here)

    def _aimed(self, targets: Mapping[str, Any]) -> Controller:
        """Return the requested controller with some targets replaced."""
        return replace(self._wanted, tasks=with_targets(self._wanted.tasks, targets))


def _percentiles(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    if not len(values):
        return 0.0, 0.0, 0.0
    median, late = np.percentile(values, (50.0, 99.0))
    return float(median), float(late), float(values.max())


def be_nice(niceness: int) -> None:
    """Set the niceness of the calling thread on Linux, where threads have their own; below 0 needs root."""
    if sys.platform == "linux":
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
