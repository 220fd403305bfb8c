"""One weighted QP in the CPU kernel: the problem, space to work in, and the labels that a lane begins with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...numerics._constants import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE
from ._frame import lean


class Problem(NamedTuple):
    """One problem, the roots of its weights multiplied in.

    Fields: ``rows`` [sqrt(W) A; C], (m + p, n). ``target`` sqrt(W) target, (m,). ``compliance`` ones, then those of the
    rows of C, (m + p,). ``damping`` and ``center`` (n,). ``lower`` and ``upper`` (n + p,). ``root`` of the Hessian's
    diagonal, the unit in which each variable is measured, (n,).
    """

    rows: np.ndarray
    target: np.ndarray
    compliance: np.ndarray
    damping: np.ndarray
    center: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    root: np.ndarray


class Workspace(NamedTuple):
    """Space for one problem, used again by the next; k = m + p rows, N = n + p constraints, q = max(n, k).

    Fields: ``square`` (q, q) a Cholesky factor. ``scaled`` (k, n) rows over the roots of the damping. ``reduced``
    (p, n) and ``schur`` (p, p): rows of C behind the factor of the Hessian. ``used`` (k,) numbers of rows. ``right``
    (q,). ``inverse_root`` of the damping, ``step`` and ``gradient`` (n,). ``value_roundoff`` and
    ``multiplier_roundoff`` (N,). ``next`` (N,) labels. The rest is the dual active-set method's: ``R``, ``J`` (N, N),
    ``point``, ``along``, ``reflected``, ``multipliers``, ``rates``, ``order`` (N,).
    """

    square: np.ndarray
    scaled: np.ndarray
    reduced: np.ndarray
    schur: np.ndarray
    R: np.ndarray
    J: np.ndarray
    right: np.ndarray
    inverse_root: np.ndarray
    step: np.ndarray
    gradient: np.ndarray
    value_roundoff: np.ndarray
    multiplier_roundoff: np.ndarray
    point: np.ndarray
    along: np.ndarray
    reflected: np.ndarray
    multipliers: np.ndarray
    rates: np.ndarray
    used: np.ndarray
    next: np.ndarray
    order: np.ndarray


@lean
def begin(P, A, target, weight, C, compliance):
    """Fills in the problem: rows [sqrt(W) A; C] and the root of the diagonal of A'WA + D."""
    m, n = A.shape
    p = C.shape[0]
    for j in range(n):
        P.root[j] = P.damping[j]
    for i in range(m):
        root = np.sqrt(weight[i])
        P.target[i] = root * target[i]
        P.compliance[i] = 1.0
        for j in range(n):
            entry = root * A[i, j]
            P.rows[i, j] = entry
            P.root[j] += entry * entry
    for j in range(n):
        P.root[j] = np.sqrt(P.root[j])
    for q in range(p):
        P.compliance[m + q] = compliance[q]
        for j in range(n):
            P.rows[m + q, j] = C[q, j]


@lean
def first_labels(P, guess, labels):
    """The guess where the bounds that it names exist; pinned variables are active, equality rows where guessed."""
    n = len(P.damping)
    for i in range(len(labels)):
        low, high = P.lower[i], P.upper[i]
        label = INACTIVE
        if guess[i] == AT_UPPER:
            label = AT_UPPER if abs(high) < np.inf else INACTIVE
        elif guess[i] != INACTIVE:
            label = AT_LOWER if abs(low) < np.inf else INACTIVE
        labels[i] = EQUALITY if low == high and (i < n or guess[i] != INACTIVE) else label


@lean
def active_bound(P, label, i):
    """The bound at which constraint i is held."""
    return P.upper[i] if label == AT_UPPER else P.lower[i]
