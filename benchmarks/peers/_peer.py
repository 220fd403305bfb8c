"""What the benchmark asks of a library."""

from __future__ import annotations

import importlib.metadata
from typing import Protocol

import numpy as np


class Peer(Protocol):
    """A robot in closed loop: made from a workload and options of its own, it stands at the start."""

    packages: tuple[str, ...]
    """Whose versions matter."""

    def tick(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """One step, targets in and configuration out, in the library's own layout; this is timed."""
        ...

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """The workload's layout; not timed."""
        ...

    def solved(self) -> float:
        """Share of all answers so far that the library calls solved."""
        ...


def versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Of distributions."""
    return {name: importlib.metadata.version(name) for name in packages}
