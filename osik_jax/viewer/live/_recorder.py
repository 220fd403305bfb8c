"""Keeps what the robot does, while it is asked to."""

from __future__ import annotations

import threading

import numpy as np
from jaxtyping import Float

from ._snapshot import Recording

_LONGEST = 600.0
"""[s]"""


class Recorder:
    """Configurations at a fixed rate, of ten minutes at most."""

    def __init__(self, dt: float) -> None:
        """Takes the time between configurations [s]."""
        self._dt, self._lock = dt, threading.Lock()
        self._rows: list[np.ndarray] | None = None

    def start(self, q: Float[np.ndarray, "*batch nq"]) -> None:
        """Starts with a configuration, and forgets what was kept."""
        with self._lock:
            self._rows = [q.copy()]

    def add(self, q: Float[np.ndarray, "*batch nq"]) -> float | None:
        """Keeps another one; returns how long the recording is [s], None where nothing is recorded."""
        with self._lock:
            if self._rows is None:
                return None
            if len(self._rows) * self._dt <= _LONGEST:
                self._rows.append(q.copy())
            return (len(self._rows) - 1) * self._dt

    def stop(self) -> Recording:
        """Ends the recording and returns it."""
        with self._lock:
            rows, self._rows = self._rows or [], None
        return Recording(np.arange(len(rows)) * self._dt, np.array(rows) if rows else np.zeros((0, 0)))
