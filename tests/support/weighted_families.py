"""Weighted least-squares problems with rows, hard and soft, drawn by the hundred: seeded NumPy, batched."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

N, M, P = 12, 7, 5
"""Variables, rows of the cost, rows of C: fewer rows than variables. ``MANY`` rows of the cost are more."""
MANY = 16


class Problems(NamedTuple):
    """Arguments of ``solve_least_squares_qp`` with a leading axis, the lanes."""

    matrix: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: np.ndarray
    rows_lower: np.ndarray
    rows_upper: np.ndarray
    rows_compliance: np.ndarray
    damping: np.ndarray


def problems(count: int = 200, m: int = M, seed: int = 0, weakest: float = 1e-6) -> Problems:
    """Feasible: weights over five decades, dampings from ``weakest``, all kinds of bounds and rows, hard or soft."""
    rng = np.random.default_rng(seed)
    inside = rng.normal(size=(count, N))
    A, C = rng.normal(size=(count, m, N)), rng.normal(size=(count, P, N))
    low, high = inside - rng.exponential(0.5, (count, N)), inside + rng.exponential(0.5, (count, N))
    low, high = np.where(rng.random(low.shape) < 0.2, -np.inf, low), np.where(rng.random(low.shape) < 0.2, np.inf, high)
    pinned = rng.random(low.shape) < 0.05
    low, high = np.where(pinned, inside, low), np.where(pinned, inside, high)
    value = np.einsum("bpn,bn->bp", C, inside)
    below, above = value - rng.exponential(0.5, value.shape), value + rng.exponential(0.5, value.shape)
    one_sided, equal = rng.random(value.shape) < 0.3, rng.random(value.shape) < 0.15
    below, above = np.where(equal, value, below), np.where(equal, value, np.where(one_sided, np.inf, above))
    soft = rng.random(value.shape) < 0.5
    below = np.where(soft & ~equal, below + 1.0, below)  # out of reach now and then
    above = np.maximum(above, below)
    return Problems(
        *(A, 3.0 * rng.normal(size=(count, m)), 10.0 ** rng.uniform(-2.0, 3.0, (count, m)), low, high),
        *(C, below, above, np.where(soft, 10.0 ** rng.uniform(-3.0, 1.0, value.shape), 0.0)),
        10.0 ** rng.uniform(np.log10(weakest), 0.0, (count, N)),
    )


def contradicting(rng, count, every, n=12, m=7, p=5):
    """Hard rows in a box; in each ``every``-th lane two of them want opposite motions, by half to two units."""
    A, b, C = rng.normal(size=(count, m, n)), rng.normal(size=(count, m)), rng.normal(size=(count, p, n))
    lower = np.full((count, p), -1.0)
    C[::every, 1] = 0.1 * rng.normal(size=C[::every, 1].shape) - C[::every, 0]
    lower[::every, :2] = rng.uniform(2.0, 4.0, lower[::every, :2].shape)
    box = np.full((count, n), 0.7)
    return A, b, np.ones((count, m)), -box, box, C, lower, np.full((count, p), np.inf)


def soft_problems(rng, count, n, m, p):
    """Rows that give way, some of them equalities, some without bounds; a box of which a part is pinned or open.

    A pull to a centre, different from variable to variable."""
    A, C = rng.normal(size=(count, m, n)), rng.normal(size=(count, p, n))
    b, weight = rng.normal(size=(count, m)), 10.0 ** rng.uniform(-1, 1, (count, m))
    lower, upper = -rng.exponential(size=(count, n)), rng.exponential(size=(count, n))
    lower[rng.random(lower.shape) < 0.3], upper[rng.random(upper.shape) < 0.3] = -np.inf, np.inf
    upper = np.where(np.isfinite(lower) & (rng.random(lower.shape) < 0.05), lower, upper)
    low, high = rng.normal(size=(count, p)) - 0.5, np.full((count, p), np.inf)
    high = np.where(rng.random(low.shape) < 0.5, low + rng.exponential(size=low.shape), high)
    high = np.where(rng.random(low.shape) < 0.1, low, high)
    low = np.where(rng.random(low.shape) < 0.1, -np.inf, low)
    pulls = 10.0 ** rng.uniform(-2, 0, (count, n)), rng.normal(size=(count, n))
    return A, b, weight, lower, upper, C, low, high, 10.0 ** rng.uniform(-2, 0, (count, p)), *pulls
