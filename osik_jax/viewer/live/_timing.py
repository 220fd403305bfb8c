"""Timing of a loop: periods and computing times of its last steps."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


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
    """Ring buffer of the start times and durations of the last steps."""

    def __init__(self, length: int = 2000) -> None:
        """Take the number of steps to keep."""
        self._starts, self._durations, self._count = np.zeros(length), np.zeros(length), 0

    def add(self, start: float, duration: float) -> None:
        """Record a step [s]."""
        place = self._count % len(self._starts)
        self._starts[place], self._durations[place] = start, duration
        self._count += 1

    def clear(self) -> None:
        """Discard all steps, as after a pause."""
        self._count = 0

    def timing(self) -> Timing:
        """Return percentiles of the recorded steps."""
        count = min(self._count, len(self._starts))
        first = self._count % len(self._starts) if self._count > len(self._starts) else 0
        starts = np.roll(self._starts, -first)[:count]
        return Timing(self._count, _percentiles(np.diff(starts)), _percentiles(self._durations[:count]))


def _percentiles(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    if not len(values):
        return 0.0, 0.0, 0.0
    median, late = np.percentile(values, (50.0, 99.0))
    return float(median), float(late), float(values.max())
