"""Hierarchies near a singularity, drawn from the recorded ones: seeded NumPy, batched."""

from __future__ import annotations

import numpy as np
from hierarchy_families import Hierarchies, Rows
from recorded import recorded_hierarchies


def stretched(rng: np.random.Generator, count: int) -> Hierarchies:
    """The robot's Jacobians near singularity, and targets far out of reach, other than the recorded ones."""
    r = recorded_hierarchies(unit_rows=False)
    lanes = rng.choice(np.flatnonzero(r.kind >= 2), count)
    levels = []
    for k, (A, low, high) in enumerate(r.levels):
        A, low, high = A[lanes], low[lanes], high[lanes]
        far = 10.0 ** rng.uniform(-4, 0, (count, 1)) * rng.normal(size=low.shape) * (k < 3)
        levels.append(Rows(A, low + far, high + far, np.ones_like(low)))
    return Hierarchies(levels, r.lower[lanes], r.upper[lanes])
