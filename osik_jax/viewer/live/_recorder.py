"""Recorder of a robot's motion."""

from __future__ import annotations

import threading

import numpy as np
from jaxtyping import Float

from ._snapshot import Recording

_LONGEST = 600.0
"""Longest recording [s]."""


class Recorder:
    """Recorder of configurations at a fixed rate, for at most ten minutes."""

    def __init__(self, dt: float) -> None:
        """Take the time between configurations [s]."""
        self._dt, self._lock = dt, threading.Lock()
        self._rows: list[np.ndarray] | None = None

    def start(self, q: Float[np.ndarray, "*batch nq"]) -> None:
        """Start with a configuration and discard earlier ones."""
        with self._lock:
            self._rows = [q.copy()]

    def add(self, q: Float[np.ndarray, "*batch nq"]) -> float | None:
        """Append a configuration and return the length of the recording [s]; None if none runs."""
        with self._lock:
            if self._rows is None:
                return None
            if len(self._rows) * self._dt <= _LONGEST:
                self._rows.append(q.copy())
            return (len(self._rows) - 1) * self._dt

    def stop(self) -> Recording:
        """End the recording and return it."""
        with self._lock:
            rows, self._rows = self._rows or [], None
        return Recording(np.arange(len(rows)) * self._dt, np.array(rows) if rows else np.zeros((0, 0)))
