"""Background compiler of control steps; compiles each structure once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from ...robot import Robot
from ._step import Controller, Program, compile_step

_KEPT = 16
"""Number of compiled programs kept in memory."""


class Compiler:
    """Thread that compiles the most recently requested controller, and calls back when done."""

    def __init__(
        self,
        robot: Robot,
        dt: float,
        batch: int | None,
        done: Callable[[Controller, Program], None],
        failed: Callable[[Controller, Exception], None],
    ) -> None:
        """Take the number of robots (None: one, without a batch axis) and the callback, which the thread calls."""
        self._batch = batch
        self._robot, self._dt, self._done, self._failed = robot, dt, done, failed
        self._programs: dict[tuple[Any, ...], Program] = {}
        self._asked: Controller | None = None
        self._news, self._end = threading.Event(), False
        self.thread = threading.Thread(target=self._work, name="osik-compile", daemon=True)

    def ask(self, controller: Controller) -> None:
        """Request the compilation of a controller; it replaces earlier requests that have not started."""
        self._asked = controller
        self._news.set()

    def stop(self) -> None:
        """End the thread after the current compilation."""
        self._end = True
        self._news.set()
        if self.thread.is_alive():
            self.thread.join()

    def _work(self) -> None:
        while self._news.wait() and not self._end:
            self._news.clear()
            controller, self._asked = self._asked, None
            if controller is not None:
                self._compile(controller)

    def _compile(self, controller: Controller) -> None:
        structure = controller.structure()
        try:
            program = self._programs.get(structure) or compile_step(self._robot, controller, self._dt, self._batch)
        except Exception as error:  # whatever a task of somebody's own raises must not end the thread
            self._failed(controller, error)
            return
        self._programs[structure] = program
        while len(self._programs) > _KEPT:
            self._programs.pop(next(iter(self._programs)))
        self._done(controller, program)
