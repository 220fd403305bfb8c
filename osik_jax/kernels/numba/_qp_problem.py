"""One weighted QP in the CPU kernel: the problem, space to work in, and the labels that a lane begins with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...numerics._constants import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE
from ._frame import lean
from ._padded_rows import plus_squares, put_inverse, put_multiple, put_root
from ._tiles import padded
from ._transpose import transpose


class Problem(NamedTuple):
    """One problem, the roots of its weights multiplied in.

    Fields: ``rows`` [sqrt(W) A; C], (m + p, n), and ``turned``, its transpose. ``target`` sqrt(W) target, (m,), and
    ``goal``, the same and noughts, (m + p,). ``compliance`` ones, then those of the rows of C, (m + p,). ``damping``
    and ``center`` (n,). ``lower`` and ``upper`` (n + p,). ``root`` of the Hessian's diagonal, the unit in which each
    variable is measured, and ``inverse_root``, 1 over it, (n,). All but bounds and compliance are ``padded``.
    """

    rows: np.ndarray
    turned: np.ndarray
    target: np.ndarray
    goal: np.ndarray
    compliance: np.ndarray
    damping: np.ndarray
    center: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    root: np.ndarray
    inverse_root: np.ndarray


class Workspace(NamedTuple):
    """Space for one problem, used again by the next; k = m + p rows, N = n + p constraints, q = max(n, k).

    Fields: ``square`` (q, q) a Cholesky factor. Of the rows' space ``gram`` (k, k), its ``factor`` and
    ``turned_factor`` (k, k), ``pivots`` (k,). ``columns`` (n, k) of the used rows, and ``scaled`` (n, k) those over the
    damping, negative. ``reduced`` (p, n) and ``schur`` (p, p): rows of C behind the factor of the Hessian. ``used``
    (k,) numbers of rows; ``gap`` and ``row_terms`` (k,). ``right`` (q,), ``solved`` (k,). ``inverse`` of the
    damping, ``step``, ``gradient`` and ``ones`` (n,). ``value_roundoff`` and ``multiplier_roundoff`` (N,). ``next``
    (N,) labels. The rest is the dual active-set method's: ``R``, ``J`` (N, N), ``point``, ``along``, ``reflected``,
    ``multipliers``, ``rates``, ``order`` (N,). Vectors are ``padded``, and so are rows and columns of what is (k, k) or
    (n, k).
    """

    square: np.ndarray
    gram: np.ndarray
    factor: np.ndarray
    turned_factor: np.ndarray
    columns: np.ndarray
    scaled: np.ndarray
    reduced: np.ndarray
    schur: np.ndarray
    R: np.ndarray
    J: np.ndarray
    right: np.ndarray
    solved: np.ndarray
    pivots: np.ndarray
    gap: np.ndarray
    row_terms: np.ndarray
    ones: np.ndarray
    inverse: np.ndarray
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
def begin(P, A, target, weight, damping, center, C, compliance):
    """Fills in the problem: rows [sqrt(W) A; C] and the root of the diagonal of A'WA + D."""
    m, n = A.shape
    p = C.shape[0]
    wide = padded(n)
    put_multiple(P.damping, 1.0, damping, n)
    put_multiple(P.center, 1.0, center, n)
    for i in range(m):
        root = np.sqrt(weight[i])
        P.target[i] = root * target[i]
        P.compliance[i] = 1.0
        put_multiple(P.rows[i], root, A[i], n)
    for q in range(p):
        P.compliance[m + q] = compliance[q]
        put_multiple(P.rows[m + q], 1.0, C[q], n)
    transpose(P.turned, P.rows, m + p, n)
    plus_squares(P.root, P.damping, P.damping, P.rows, 0, m, 0, wide)
    put_root(P.root, P.root, wide)
    put_inverse(P.inverse_root, P.root, wide)


@lean
def first_labels(P, guess, labels):
    """Take the guess where the bounds that it names exist; pinned variables are active, equality rows where guessed."""
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
    """Return the bound at which constraint i is active."""
    return P.upper[i] if label == AT_UPPER else P.lower[i]
