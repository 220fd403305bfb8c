"""What the benchmark asks of a library."""

from __future__ import annotations

import importlib.metadata
from typing import NamedTuple, Protocol

import numpy as np


class Device(NamedTuple):
    """An accelerator, and the most memory that it has held; of a CPU, nothing."""

    name: str | None = None
    peak_bytes: int | None = None


class Peer(Protocol):
    """A robot in closed loop: made from a workload and options of its own, it stands at the start.

    Those in ``BATCHED`` have the options ``batch``, a number of robots, and ``resident``: the configurations of so many
    robots come back, those of the others stay where they were computed.
    """

    packages: tuple[str, ...]
    """Whose versions matter."""

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """One step, targets in and configuration out, in the library's own layout; this is timed."""
        ...

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """The workload's layout; not timed."""
        ...

    def solved(self) -> float:
        """Share of all answers so far that the library calls solved; NaN where it does not say."""
        ...

    def device(self) -> Device:
        """The accelerator that it runs on."""
        ...


def versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Of distributions; "unknown" of what is importable without being installed, such as a checkout."""
    return {name: _version(name) for name in packages}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
