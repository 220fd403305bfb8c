"""Optimality conditions recomputed in NumPy float64, and reference answers from quadprog, daqp and SciPy."""

from __future__ import annotations

import daqp
import numpy as np
import quadprog
from problem_families import QPs
from scipy.optimize import lsq_linear, nnls

SMALLEST = np.finfo(float).tiny


def kkt_residual(p: QPs, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Largest violation of the optimality conditions of each lane, without units: the same in every scaling.

    Stationarity and multipliers are shares of the terms that they are made of, violations and gaps are in the natural
    units of the variables. The multipliers of the box are what stationarity leaves over.
    """
    size = np.abs(p.H) @ np.abs(x)[..., None]
    size = size[..., 0] + np.abs(p.g) + np.einsum("bpn,bp->bn", np.abs(p.C), np.abs(y)) + SMALLEST
    z = np.einsum("bij,bj->bi", p.H, x) + p.g - np.einsum("bpn,bp->bn", p.C, y)
    row_unit = np.einsum("bpn,bn->bp", np.abs(p.C), p.unit)
    row_unit = np.where(row_unit > 0.0, row_unit, 1.0)
    share = np.max(np.abs(y)[..., None] * np.abs(p.C) / size[:, None, :], -1) * np.sign(y)
    values = np.einsum("bpn,bn->bp", p.C, x)
    return np.maximum(
        _one_sided(x, p.lower, p.upper, p.unit, z / size).max(-1),
        _one_sided(values, p.row_lower, p.row_upper, row_unit, share).max(-1),
    )


def _one_sided(s: np.ndarray, lower: np.ndarray, upper: np.ndarray, unit: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Violation, or a push away from a bound that is not near."""
    above, below = (s - lower) / unit, (upper - s) / unit
    return np.max([-above, -below, np.minimum(push, above), np.minimum(-push, below)], 0)


def by_daqp(p: QPs, i: int) -> np.ndarray | None:
    """Solution of lane i, None where daqp does not claim one."""
    low, high = np.r_[p.lower[i], p.row_lower[i]], np.r_[p.upper[i], p.row_upper[i]]
    used = np.r_[np.full(len(p.x[i]), True), np.isfinite(p.row_lower[i]) | np.isfinite(p.row_upper[i])]
    C = np.ascontiguousarray(p.C[i][used[len(p.x[i]) :]])
    low, high = low[used], high[used]
    sense = np.where(low == high, 5, 0).astype(np.int32)
    clipped = np.clip(low, -1e30, 1e30), np.clip(high, -1e30, 1e30)
    x, _, flag, _ = daqp.solve(p.H[i], p.g[i], C, clipped[1], clipped[0], sense, primal_tol=1e-11)
    return np.asarray(x) if flag == 1 else None


def by_quadprog(p: QPs, i: int) -> np.ndarray | None:
    """Solution of lane i, None where quadprog does not claim one (dependent equalities)."""
    normals = np.vstack([np.eye(len(p.x[i])), p.C[i]])
    low, high = np.r_[p.lower[i], p.row_lower[i]], np.r_[p.upper[i], p.row_upper[i]]
    equal = low == high
    from_below, from_above = np.isfinite(low) & ~equal, np.isfinite(high) & ~equal
    G = np.vstack([normals[equal], normals[from_below], -normals[from_above]])
    h = np.r_[low[equal], low[from_below], -high[from_above]]
    try:
        return quadprog.solve_qp(p.H[i], -p.g[i], G.T, h, int(equal.sum()))[0]
    except ValueError:
        return None


def outside_cone(gradient: np.ndarray, both: np.ndarray, pushed_up: np.ndarray, pushed_down: np.ndarray) -> float:
    """Distance of a gradient from the multipliers that can hold it.

    Args:
        gradient: of the cost.
        both: rows held as equalities.
        pushed_up: rows at their lower bound: their multipliers are >= 0.
        pushed_down: rows at their upper bound.
    """
    normals = np.vstack([both, -both, pushed_up, -pushed_down])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0.0] / length[length > 0.0, None]
    if not len(normals):
        return float(np.linalg.norm(gradient))
    return float(nnls(normals.T, gradient, maxiter=50 * len(normals))[1])


def least_violation(p: QPs, i: int) -> float:
    """Smallest |C x - its interval| over the box of lane i, by SciPy's bounded least squares on (x, nearest value)."""
    used = np.isfinite(p.row_lower[i]) | np.isfinite(p.row_upper[i])
    C, low, high = p.C[i][used], p.row_lower[i][used], p.row_upper[i][used]
    equal = low == high
    matrix = np.hstack([C, -np.eye(len(C))[:, ~equal]])
    box = np.r_[p.lower[i], low[~equal]], np.r_[p.upper[i], high[~equal]]
    answer = lsq_linear(matrix, np.where(equal, low, 0.0), box, method="bvls", tol=1e-15, max_iter=1000)
    return float(np.sqrt(2.0 * answer.cost))


def least_violation_residual(p: QPs, i: int, x: np.ndarray, near: float = 1e-9) -> float:
    """How far x is from the least violation of its rows, and from the least cost among all x of that violation."""
    C, low, high = p.C[i], p.row_lower[i], p.row_upper[i]
    eye = np.eye(len(x))
    value = C @ x
    violation = value - np.clip(value, low, high)
    at_lower, at_upper = eye[x <= p.lower[i] + near], eye[x >= p.upper[i] - near]
    first = outside_cone(C.T @ violation, np.zeros((0, len(x))), at_lower, at_upper)
    both = (low == high) | (np.abs(violation) > near)
    up, down = ~both & (value <= low + near), ~both & (value >= high - near)
    slope = p.H[i] @ x + p.g[i]
    second = outside_cone(slope, C[both], np.vstack([at_lower, C[up]]), np.vstack([at_upper, C[down]]))
    return max(first, second)
