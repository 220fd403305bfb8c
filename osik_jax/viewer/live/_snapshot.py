"""State of a control loop for other threads, and recordings of its motion."""

from __future__ import annotations

import dataclasses
import io
import threading
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...solvers import Status

_LONGEST = 600.0
"""Longest recording [s]."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """State after the last step.

    Attributes:
        time: simulated since the start or the last reset [s].
        q: configuration. (nq,), of a batch (B, nq), and so the others
        velocity: what the controller asked for. (nv,)
        status: a ``Status`` code; of a batch, the highest.
        errors: of each task. {name: (m,)}
        failures: steps since the start or the last reset whose answer could not be used: the robot stood still.
        ready: whether a compiled step runs; before that, the robot stands still.
        preparing: whether what was asked for is still being compiled.
        paused: whether the robot stands still because it was asked to.
        recording: length of the recording [s]; None where nothing is recorded.
        problem: why the last change could not be compiled; empty where it could.
    """

    time: float
    q: Float[np.ndarray, "*batch nq"]
    velocity: Float[np.ndarray, "*batch nv"]
    status: int = int(Status.SOLVED)
    errors: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    failures: int = 0
    ready: bool = False
    preparing: bool = False
    paused: bool = False
    recording: float | None = None
    problem: str = ""


class Recording(NamedTuple):
    """Recorded motion."""

    time: Float[np.ndarray, " T"]  # of each configuration [s]
    q: Float[np.ndarray, "T *batch nq"]  # configurations. (T, nq), of a batch

    def to_npz(self, **runs: Float[np.ndarray, "T nq"]) -> bytes:
        """Return a file of configurations by name (``q_NAME``) at the recording's times, as ``osik demo`` writes it."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, time=self.time, **runs)
        return buffer.getvalue()


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
