"""Control loop in its own thread; requests take effect between steps and never block it."""

from __future__ import annotations

import atexit
import gc
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._errors import OsikValueError, unknown_name
from ...robot import Robot
from ...solvers import Status
from ._compiler import Compiler
from ._obstacles import moved
from ._snapshot import Recorder, Recording, Snapshot
from ._step import Controller, Program, State, targets_here, with_targets
from ._timing import CONTROL, Stopwatch, Timing, be_nice

_LATE = 5
"""Number of periods of delay after which a loop restarts its schedule instead of catching up."""
_SWITCH_INTERVAL = 5e-5
"""GIL switch interval while a loop runs [s]."""
_HALF_A_MICROSECOND = 5e-7
"""Offset [s] added to the switch interval, which Python truncates to whole microseconds."""
_loops: set[int] = set()
"""Identities of the running loops. The last one to stop unfreezes the objects of Python's garbage collector."""


class _Job(NamedTuple):
    """A compiled program and its numbers, as the control thread runs them."""

    program: Program
    numbers: list[Array]


class _Lease(NamedTuple):
    """Owner of a task's target, and the time until which the target counts as fresh [s]."""

    owner: Hashable
    until: float


class ControlLoop:
    """Controller running at a fixed rate in its own thread.

    All methods may be called from any thread. Numbers (targets, weights, gains, limits) take effect in the next step.
    Another structure (another task, scheme, priority or limit) is compiled in the background, while the present
    controller goes on and follows new targets. The new one then starts at the current configuration.

    The robot stands still while nothing is compiled yet, while paused, and after an answer that is not finite. If the
    owner of a target (``aim``) leaves or its timeout passes, the target becomes the robot's current pose.

    A batch of B robots runs in one program: q0 is (B, nq), and each number of the controller has a leading axis B. So
    have targets, snapshots and recordings.

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
        self.robot, self.dt = robot, float(dt)
        self._start = np.asarray(start, robot.q0.dtype)
        self._batched = self._start.ndim == 2
        for row in self._start if self._batched else [start]:
            robot.check_configuration(row, "q0")
        still = np.zeros((*self._start.shape[:-1], robot.nv), self._start.dtype)
        self._lock = threading.RLock()
        self._wanted = self._running = controller
        self._leases: dict[str, _Lease] = {}
        self._job: _Job | None = None
        self._is_behind, self._problem = False, ""
        self._orders: deque[Callable[[], None]] = deque()
        self._stopwatch, self._recorder = Stopwatch(), Recorder(self.dt)
        self._snapshot = Snapshot(0.0, self._start, still, preparing=True)
        self._state: State = (jnp.asarray(self._start), jnp.asarray(still), None)
        self._program: Program | None = None
        self._stop = threading.Event()
        batch = len(self._start) if self._batched else None
        self._compiler = Compiler(robot, self.dt, batch, self._compiled, self._not_compiled)
        self._thread = threading.Thread(target=self._run, name="osik-control", daemon=True)

    def start(self) -> Self:
        """Start the threads; the first step is compiled in the background.

        While it runs, Python's threads change places every 0.05 ms, not every 5: the control thread would wait that
        long for each of the others that computes. What was there when a program was compiled is left out of
        garbage collection until the loop ends: going through all of JAX's objects takes up to 0.1 s.
        """
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(_SWITCH_INTERVAL, self._switch_interval))
        _loops.add(id(self))
        # a thread that is inside XLA when Python ends may crash the process
        atexit.register(self.stop)
        # the compiler starts first: the control thread needs its program
        self._compiler.thread.start()
        self._compiler.ask(self._wanted)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the threads, after the current compilation: no thread may be inside XLA when Python ends."""
        atexit.unregister(self.stop)
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
            sys.setswitchinterval(self._switch_interval + _HALF_A_MICROSECOND)
            _loops.discard(id(self))
            if not _loops:
                gc.unfreeze()
        self._compiler.stop()

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
        """Return the requested controller, which runs as soon as it is compiled; the same object until it changes."""
        return self._wanted

    @property
    def timing(self) -> Timing:
        """Return periods and step times of the last steps since the start or the last pause."""
        return self._stopwatch.timing()

    def wait_until_ready(self, timeout: float = 60.0) -> bool:
        """Wait until the requested controller runs; return False if it does not within the timeout [s]."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if self._job is not None and not self._is_behind:
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
            self._is_behind = self._wanted.structure() != self._running.structure()
            if not self._is_behind:
                self._running = self._wanted
                self._refresh()
            if self._is_behind or self._job is None:
                self._compiler.ask(self._wanted)

    def aim(self, name: str, target: Any, *, owner: Hashable = None, timeout: float | None = None) -> None:
        """Set the target of a task, also while another structure is being compiled.

        Args:
            name: of the task.
            target: what ``task.replace(target=...)`` takes.
            owner: who leads it; ``release(owner)`` holds the robot where it is.
            timeout: if no other target comes within this time, the robot is held where it is [s].

        Raises:
            KeyError: no such task.
            TypeError, ValueError: no such target.
        """
        if name not in self._wanted.tasks:
            raise unknown_name("task", name, tuple(self._wanted.tasks))

        def aimed(task: Any, target: Any) -> Any:
            return task.replace(target=target).target

        task = self._wanted.tasks[name]
        new = jax.vmap(aimed)(task, target) if self._batched else aimed(task, target)
        until = np.inf if timeout is None else time.monotonic() + timeout
        with self._lock:
            self._leases.pop(name, None)
            if owner is not None or timeout is not None:
                self._leases[name] = _Lease(owner, until)
            self._edit_both(lambda controller: with_targets(controller, {name: new}))

    def place(self, obstacle: str, **changes: Float[np.ndarray, "..."]) -> None:
        """Set position, rotation or size of an obstacle (``CollisionAvoidanceLimit.moved``) in all controllers."""
        with self._lock:
            self._edit_both(lambda own: replace(own, limits=moved(own.limits, obstacle, **changes)))

    def let_go(self, owner: Hashable) -> None:
        """Keep the targets where their owner left them, without a timeout."""
        with self._lock:
            self._leases = {name: lease for name, lease in self._leases.items() if lease.owner != owner}

    def release(self, owner: Hashable) -> None:
        """Set the targets of an owner who left to the robot's current pose."""
        with self._lock:
            left = [name for name, lease in self._leases.items() if lease.owner == owner]
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

    def record(self) -> None:
        """Start a recording of at most ten minutes; a running one is discarded."""
        self._orders.append(lambda: self._recorder.start(self._snapshot.q))

    def recorded(self) -> Recording:
        """End the recording and return it; empty if none ran."""
        return self._recorder.stop()

    def _refresh(self) -> None:
        """Copy the controller's numbers to the running program; the caller holds the lock."""
        if self._job is not None:
            self._job = self._job._replace(numbers=self._running.numbers())

    def _edit_both(self, edit: Callable[[Controller], Controller]) -> None:
        """Change numbers of the running and of the requested controller; the caller holds the lock."""
        is_one = self._wanted is self._running
        self._wanted = edit(self._wanted)
        self._running = self._wanted if is_one else edit(self._running)
        self._refresh()

    def _compiled(self, controller: Controller, program: Program) -> None:
        """Run a compiled program unless another controller has been requested since."""
        if not self._stop.is_set():
            # a collection over all of JAX's objects takes up to 0.1 s, several periods of the loop
            gc.freeze()
        with self._lock:
            if controller.structure() == self._wanted.structure():
                # numbers may have changed during compilation, so the wanted controller runs, not the compiled one
                self._running, self._is_behind = self._wanted, False
                self._job = _Job(program, self._running.numbers())
        if not self._stop.is_set():
            self._here(list(controller.tasks))  # compiled here, so that the control thread need not

    def _not_compiled(self, controller: Controller, error: Exception) -> None:
        """Return to the running controller and report the error."""
        with self._lock:
            if controller.structure() == self._wanted.structure():
                self._wanted, self._is_behind = self._running, False
                self._problem = " ".join(str(error).split())

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
        self._hold(self._abandoned())
        job = self._job
        self._show(ready=job is not None, preparing=job is None or self._is_behind, problem=self._problem)
        if job is None or self._snapshot.paused:
            # periods across a pause would count as late
            self._stopwatch.clear()
            return
        self._step(job)
        self._stopwatch.add(begin, time.perf_counter() - begin)

    def _step(self, job: _Job) -> None:
        """Run one step; if its answer is unusable, stop the robot and cold-start the solver."""
        if job.program is not self._program:
            self._program, self._state = job.program, (*self._state[:2], job.program.cold)
        state, status, errors = job.program.run(job.numbers, self._state)
        before, codes = self._snapshot, np.asarray(status)
        q, velocity = np.asarray(state[0]), np.asarray(state[1])
        usable = np.isfinite(q).all(-1, keepdims=True) & (codes != Status.NUMERICAL_ERROR)[..., None]
        if usable.all():
            self._state = state
        else:
            # in a batch, robots with usable answers go on
            q, velocity = np.where(usable, q, before.q), np.where(usable, velocity, 0.0)
            self._state = (jnp.asarray(q), jnp.asarray(velocity), job.program.cold)
        self._show(
            time=before.time + self.dt,
            q=q,
            velocity=velocity,
            status=int(codes.max()),
            errors={name: np.asarray(error) for name, error in errors.items()},
            failures=before.failures + int(np.sum(~usable)),
            recording=self._recorder.add(q),
        )

    def _show(self, **changes: Any) -> None:
        self._snapshot = replace(self._snapshot, **changes)

    def _reset(self) -> None:
        """Move the robot to the start, at rest."""
        still = np.zeros_like(self._snapshot.velocity)
        cold = None if self._program is None else self._program.cold
        self._state = (jnp.asarray(self._start), jnp.asarray(still), cold)
        self._show(time=0.0, q=self._start, velocity=still, failures=0)

    def _abandoned(self) -> list[str]:
        """Return the tasks whose target is older than allowed."""
        now = time.monotonic()
        return [name for name, lease in list(self._leases.items()) if lease.until < now]

    def _hold(self, names: list[str]) -> None:
        """Set the targets of these tasks to the robot's current pose."""
        if not names:
            return
        here = self._here(names)
        with self._lock:
            self._leases = {name: lease for name, lease in self._leases.items() if name not in names}
            self._edit_both(lambda controller: with_targets(controller, here))

    def _here(self, names: list[str]) -> dict[str, Any]:
        """Return the targets that tasks meet at the robot's current configuration."""
        q, tasks = self._snapshot.q, {name: self._running.tasks[name] for name in names if name in self._running.tasks}
        if not self._batched:
            return targets_here(self.robot, q, tasks, names)
        own = [jax.tree.map(lambda leaf, lane=lane: leaf[lane], tasks) for lane in range(len(q))]
        each = [targets_here(self.robot, row, lane, names) for row, lane in zip(q, own, strict=True)]
        return jax.tree.map(lambda *rows: np.stack(rows), *each)
