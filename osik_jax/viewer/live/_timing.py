"""Timing of a loop (periods and computing times of its last steps), and the priority of its thread."""

from __future__ import annotations

import dataclasses
import os
import sys
import threading
from collections import deque
from contextlib import suppress

import numpy as np
from jaxtyping import Float

CONTROL, DRAWING = -10, 5
"""Niceness of the control and drawing threads; other threads have 0."""


def be_nice(niceness: int) -> None:
    """Set the niceness of the calling thread on Linux, where threads have their own; below 0 needs root."""
    if sys.platform == "linux":
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


@dataclasses.dataclass(frozen=True)
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


def _percentiles(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    if not len(values):
        return 0.0, 0.0, 0.0
    median, late = np.percentile(values, (50.0, 99.0))
    return float(median), float(late), float(values.max())
