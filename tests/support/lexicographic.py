"""What makes an answer lexicographically optimal, checked in NumPy float64 with SciPy's NNLS and quadprog.

The minimisers of a level, among those of the levels above, are a polyhedron: rows that are equalities or violated keep
their values, the others stay in their intervals. So x is optimal for the next level if its gradient is held by
multipliers of that polyhedron: both signs for what is fixed, one for what is at a bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import quadprog
from hierarchy_families import Hierarchies
from optimality import outside_cone


class Weighted(NamedTuple):
    """One level of one lane with its weights multiplied in, zero rows and rows of weight 0 left out."""

    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    scale: float  # length of the longest row


def level(p: Hierarchies, k: int, i: int) -> Weighted:
    r = p.levels[k]
    keep = (r.weight[i] > 0.0) & (np.abs(r.A[i]).max(-1, initial=0.0) > 0.0)
    root = np.sqrt(r.weight[i][keep])
    A = root[:, None] * r.A[i][keep]
    scale = np.linalg.norm(A, axis=1).max(initial=0.0)
    return Weighted(A, root * r.lower[i][keep], root * r.upper[i][keep], scale)


def distance(rows: Weighted, x: np.ndarray) -> np.ndarray:
    value = rows.A @ x
    return value - np.clip(value, rows.lower, rows.upper)


def norms(p: Hierarchies, i: int, x: np.ndarray) -> np.ndarray:
    """|w_k| of each level in units of its longest row."""
    rows = [level(p, k, i) for k in range(len(p.levels))]
    return np.array([np.linalg.norm(distance(r, x)) / (r.scale or 1.0) for r in rows])


def certificate(p: Hierarchies, i: int, x: np.ndarray, near: float = 1e-9) -> np.ndarray:
    """Part of each level's gradient that no multiplier holds, in units of the level's longest row; then that of |x|^2.

    ``near`` is the distance, in units of a row, at which a bound counts as reached.
    """
    n = len(x)
    eye = np.eye(n)
    equal = p.lower[i] == p.upper[i]
    both = eye[equal]
    up, down = eye[~equal & (x <= p.lower[i] + near)], eye[~equal & (x >= p.upper[i] - near)]
    out = []
    for k in range(len(p.levels)):
        r = level(p, k, i)
        w = distance(r, x)
        out.append(outside_cone(r.A.T @ w / (r.scale**2 or 1.0), both, up, down))
        close = near * np.linalg.norm(r.A, axis=1)
        fixed = (r.lower == r.upper) | (np.abs(w) > close)
        value = r.A @ x
        both = np.vstack([both, r.A[fixed]])
        up = np.vstack([up, r.A[~fixed & (value <= r.lower + close)]])
        down = np.vstack([down, r.A[~fixed & (value >= r.upper - close)]])
    out.append(outside_cone(x, both, up, down))
    return np.array(out)


class _Face(NamedTuple):
    """x0 + Z t with G (x0 + Z t) >= h: the minimisers so far."""

    x: np.ndarray
    Z: np.ndarray
    G: np.ndarray
    h: np.ndarray


def reference(p: Hierarchies, i: int) -> tuple[np.ndarray, np.ndarray]:
    """x and the level norms, level by level: quadprog on (t, w), proximal in t, fixed rows eliminated.

    Rows with a multiplier are tight on all minimisers: they are fixed before the next level.
    """
    n = len(p.lower[i])
    pins = p.lower[i] == p.upper[i]
    x = np.clip(np.zeros(n), p.lower[i], p.upper[i])
    eye = np.eye(n)
    low, high = ~pins & np.isfinite(p.lower[i]), ~pins & np.isfinite(p.upper[i])
    face = _Face(x, eye[:, ~pins], np.vstack([eye[low], -eye[high]]), np.r_[p.lower[i][low], -p.upper[i][high]])
    for k in range(len(p.levels)):
        r = level(p, k, i)
        face = _descend(face, r.A / (r.scale or 1.0), r.lower / (r.scale or 1.0), r.upper / (r.scale or 1.0))
    face = _descend(face, eye, np.zeros(n), np.zeros(n))
    return face.x, norms(p, i, face.x)


def _descend(face: _Face, A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> _Face:
    if not len(A) or not face.Z.shape[1]:
        return face
    x, tight = _minimise(face, A, lower, upper)
    value = A @ x
    w = value - np.clip(value, lower, upper)
    length = np.linalg.norm(A, axis=1)
    fixed = (lower == upper) | (np.abs(w) > 1e-9 * length)
    frozen = np.vstack([A[fixed] / length[fixed, None], face.G[tight]]) @ face.Z
    _, sizes, V = np.linalg.svd(frozen)
    Z = face.Z @ V[int((sizes > 1e-9).sum()) :].T
    low, high = ~fixed & np.isfinite(lower), ~fixed & np.isfinite(upper)
    G = np.vstack([face.G[~tight], A[low] / length[low, None], -A[high] / length[high, None]])
    h = np.r_[face.h[~tight], lower[low] / length[low], -upper[high] / length[high]]
    matters = np.linalg.norm(G @ Z, axis=1) > 1e-9 if Z.shape[1] else np.zeros(len(G), bool)
    return _Face(x, Z, G[matters], np.minimum(h, G @ x)[matters])


def _minimise(face: _Face, A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least |w| over the face, and which of its rows carry a multiplier."""
    n, m = face.Z.shape[1], len(A)
    equal = lower == upper
    low, high = np.isfinite(lower) & ~equal, np.isfinite(upper) & ~equal
    AZ, GZ, eye = A @ face.Z, face.G @ face.Z, np.eye(m)
    G = np.vstack(
        [
            np.hstack([AZ[equal], -eye[equal]]),
            np.hstack([GZ, np.zeros((len(GZ), m))]),
            np.hstack([AZ[low], -eye[low]]),
            np.hstack([-AZ[high], eye[high]]),
        ]
    )
    x, count = face.x, int(equal.sum())
    H = np.diag(np.r_[np.full(n, 1e-8), np.ones(m)])
    multipliers = np.zeros(len(G))
    for _ in range(30):
        h = np.r_[(lower - A @ x)[equal], face.h - face.G @ x, (lower - A @ x)[low], (A @ x - upper)[high]]
        answer = quadprog.solve_qp(H, np.zeros(n + m), G.T, h, count)
        step, multipliers = face.Z @ answer[0][:n], answer[4]
        x = x + step
        if np.abs(step).max() < 1e-13:
            break
    tight = multipliers[count : count + len(GZ)] > 1e-10
    return _polish(face, tight, A, lower, upper, x), tight


def _polish(
    face: _Face, tight: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Least squares on the rows that count, with the tight rows exact; x itself where that does not fit."""
    held = face.G[tight] @ face.Z
    Z = face.Z
    y = x
    if len(held):
        y = x + Z @ np.linalg.lstsq(held, (face.h - face.G @ x)[tight], rcond=1e-12)[0]
        _, sizes, V = np.linalg.svd(held)
        Z = Z @ V[int((sizes > 1e-10).sum()) :].T
    value = A @ y
    w = value - np.clip(value, lower, upper)
    counts = (lower == upper) | (np.abs(w) > 1e-9 * np.linalg.norm(A, axis=1))
    if Z.shape[1]:
        y = y - Z @ np.linalg.lstsq(A[counts] @ Z, w[counts], rcond=1e-12)[0]
    value = A @ y
    better = np.linalg.norm(value - np.clip(value, lower, upper)) <= np.linalg.norm(w) + 1e-12
    return y if better and (face.G @ y >= face.h - 1e-12).all() else x
