"""Rows of limits outside ``jit``: computed by the core, straight into the numbers of a step (``_plain_step.py``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..collision._core import core_scene
from ..core._plain import functions
from ..limits import CollisionAvoidanceLimit, Limit


def with_plain_rows(limits: Sequence[Limit]) -> list[CollisionAvoidanceLimit]:
    """Return the limits whose rows the core computes alone."""
    return [limit for limit in limits if isinstance(limit, CollisionAvoidanceLimit) and limit.kept is not None]


class PlainRows:
    """Rows of a ``CollisionAvoidanceLimit`` with a scene, written into ``jacobian`` and ``lower``."""

    def __init__(
        self, limit: CollisionAvoidanceLimit, jacobian: Float[np.ndarray, "k nv"], lower: Float[np.ndarray, " k"]
    ) -> None:
        assert limit.kept is not None
        self._jacobian, self._lower, self._count = jacobian, lower, limit.max_pairs
        self._robot = np.asarray(limit.kept.core.integers), np.asarray(limit.kept.core.numbers)
        self._free = functions().rows_free  # while the process ends, modules are gone before objects
        self._handle = functions().rows_new(*(part.ctypes.data for part in self._robot), self._count)
        if not self._handle:
            raise MemoryError("there is no memory for the shapes of a robot")
        self._numbers, self._scene = np.zeros(5), None
        self.take(limit)

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._free(self._handle)

    def take(self, limit: CollisionAvoidanceLimit) -> None:
        """Take the numbers of a limit of the same structure."""
        assert limit.kept is not None and limit.scene is not None
        self._numbers[:] = limit.numbers(0.0)
        if limit.scene is not self._scene:
            parts = core_scene(limit.scene, limit.kept.shapes)
            arrays = np.ascontiguousarray(parts.integers), np.ascontiguousarray(parts.numbers, np.float64)
            functions().rows_set(self._handle, *(part.ctypes.data for part in arrays))
            self._scene = limit.scene

    def fill(self, q: int, dt: float) -> None:
        """Compute the rows at a configuration, given by its address, for a step of ``dt`` [s]."""
        self._numbers[4] = dt
        places: Any = self._numbers.ctypes.data, self._jacobian.ctypes.data, self._lower.ctypes.data
        functions().rows(self._handle, q, *places)
