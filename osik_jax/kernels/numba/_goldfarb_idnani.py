"""The dual active-set method from a cold start, with factors that are updated.

D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs", Mathematical
Programming 27, 1983. Rows of C may be soft, so the unknowns are v = (x, s) with t = sqrt(E) s and E their
compliances; the cost is 1/2 |s|^2 more, and constraint i has the normal n_i = e_i for a bound, (C_q, sqrt(E_q) e_q) for
a row. With N the normals of the active constraints, each in the direction in which it pushes,

    Hessian = U'U,    J = U^-1 Q,    J'N = [T; 0]    with Q orthogonal, T upper triangular,

and for a constraint n that enters, with d = J'n = [d1; d2]: z = J2 d2 is the direction of v, and the multipliers of
the active constraints fall at the rates r = T^-1 d1. The dual objective rises with every step, so that no active set
comes back.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, KERNEL_DEPENDENCE, REDUNDANCY_TOL
from ._dense import add_multiple, add_row, dot, fill, invert_upper, rotate
from ._frame import lean

_REDUNDANCY_TOL = REDUNDANCY_TOL[np.dtype("float64")]


@lean
def factor_cost(P, R, J, n):
    """Write J = U^-1, with U'U the Hessian, by Givens rotations, which square nothing; its rows are U^-1's columns.

    A pinned variable has a 1 in U and nothing in J, so that no step moves it.
    """
    N = len(P.lower)
    for k in range(N):
        fill(R[k], 0.0)
        fill(J[k], 0.0)
    for j in range(n):
        R[j, j] = np.sqrt(P.damping[j]) if P.lower[j] < P.upper[j] else 1.0
    v = J[N - 1]
    for i in range(len(P.target)):
        for j in range(n):
            v[j] = P.rows[i, j] if P.lower[j] < P.upper[j] else 0.0
        add_row(R, v, n)
    fill(v, 0.0)
    invert_upper(R, J, n)
    for j in range(n):
        if P.lower[j] == P.upper[j]:
            J[j, j] = 0.0
    for q in range(n, N):
        J[q, q] = 1.0


@lean
def along_normal(P, J, i, n, d):
    """Compute d = J'n_i; the rows of ``J`` are the columns of J."""
    N, m = len(P.lower), len(P.target)
    for k in range(N):
        if i < n:
            d[k] = J[k, i]
        else:
            d[k] = dot(J[k], P.rows[m + i - n], 0, n) + J[k, i] * np.sqrt(P.compliance[m + i - n])


@lean
def value_of(P, v, i, n):
    """Return n_i'v: a variable, or C_q x + t_q."""
    if i < n:
        return v[i]
    row = len(P.target) + i - n
    return dot(P.rows[row], v, 0, n) + np.sqrt(P.compliance[row]) * v[i]


@lean
def most_violated(P, W, labels, v, d, n, count):
    """Return the constraint whose activation raises the dual objective most, -1 for none; equalities first.

    By a full step it rises by half of gap^2 / |J2'n|^2. Redundant ones are passed over.
    """
    best, entering = 0.0, -1
    for i in range(len(labels)):
        if labels[i] != INACTIVE or W.next[i] != 0:
            continue
        value = value_of(P, v, i, n)
        gap = max(P.lower[i] - value, value - P.upper[i])
        if P.lower[i] == P.upper[i]:
            return i
        if gap > W.value_roundoff[i]:
            along_normal(P, W.J, i, n, d)
            gain = gap * gap / max(dot(d, d, count, len(d)), 1e-300)
            if gain > best:
                best, entering = gain, i
    return entering


@lean
def add_constraint(R, J, d, w, count):
    """Add an active constraint to T and J: a Householder reflection turns d2 into one number."""
    N = len(d)
    length = np.sqrt(dot(d, d, count, N))
    turned = -length if d[count] > 0.0 else length
    for k in range(count):
        R[k, count] = d[k]
    R[count, count] = turned
    d[count] -= turned
    half = 0.5 * dot(d, d, count, N)
    fill(w, 0.0)
    for k in range(count, N):
        add_multiple(w, d[k], J[k], N)
    for k in range(count, N):
        add_multiple(J[k], -d[k] / half, w, N)


@lean
def drop_constraint(R, J, place, count):
    """Remove an active constraint from T and J: its column goes, Givens rotations make T triangular again."""
    for k in range(place, count - 1):
        for i in range(k + 2):
            R[i, k] = R[i, k + 1]
        length = np.hypot(R[k, k], R[k + 1, k])
        if length > 0.0:
            cosine, sine = R[k, k] / length, R[k + 1, k] / length
            R[k, k], R[k + 1, k] = length, 0.0
            for j in range(k + 2, count):  # columns that have not moved up yet
                first = R[k, j]
                R[k, j] = cosine * first + sine * R[k + 1, j]
                R[k + 1, j] = cosine * R[k + 1, j] - sine * first
            rotate(J[k], J[k + 1], cosine, sine, k - k, J.shape[1])


@lean
def ratio_test(labels, order, u, r, count):
    """Return the active inequality whose multiplier reaches 0 first, and after how much; -1 and infinity for none."""
    shortest, leaving = np.inf, -1
    for i in range(count):
        if labels[order[i]] != EQUALITY and r[i] > 0.0 and u[i] / r[i] < shortest:
            shortest, leaving = u[i] / r[i], i
    return shortest, leaving


@lean
def dual_active_set(P, W, labels, x, z, count, most_changes):
    """Find the active constraints, from none but pinned variables or from where it ended, and write them to ``labels``.

    Args:
        P: the problem.
        W: space, and the roundoff of values; at the end ``next`` is 1 for constraints that depend on the active ones
            and hold, up to roundoff, where these do.
        labels: where it begins; at the start no constraint is active but pinned variables. (N,)
        x: the minimiser for those. (n,)
        z: its residuals and multipliers. (m + p,)
        count: how many constraints are active where it ended; -1 to start.
        most_changes: limit on changes of the active set.

    Returns:
        Changes of the active set, -1 where rows cannot hold together or the limit was met; how many are active.
    """
    n, N = len(x), len(labels)
    R, J, order = W.R, W.J, W.order
    v, d, w, u, r = W.point, W.along, W.reflected, W.multipliers, W.rates
    if count < 0:
        factor_cost(P, R, J, n)
        fill(W.next, 0)
        count = np.int64(0)
    for i in range(N):
        row = len(P.target) + i - n
        v[i] = x[i] if i < n else np.sqrt(P.compliance[row]) * z[row] if labels[i] != INACTIVE else 0.0
    changes = np.int64(0)  # not literals: functions of a literal are compiled once more
    while True:
        entering = most_violated(P, W, labels, v, d, n, count)
        if entering < 0:
            return changes, count
        pushed = 0.0
        value = value_of(P, v, entering, n)
        side = 1.0 if P.lower[entering] - value >= value - P.upper[entering] else -1.0
        while True:
            changes += 1
            if changes > most_changes:
                return np.int64(-1), count
            along_normal(P, J, entering, n, d)
            for k in range(N):
                d[k] *= side
            for k in range(count - 1, -1, -1):
                total = d[k]
                for j in range(k + 1, count):
                    total -= R[k, j] * r[j]
                r[k] = total / R[k, k]
            whole, left = dot(d, d, 0, N), dot(d, d, count, N)
            value = value_of(P, v, entering, n)
            gap = max(P.lower[entering] - value if side > 0.0 else value - P.upper[entering], 0.0)
            full = gap / left if left > KERNEL_DEPENDENCE * whole else np.inf
            length, leaving = ratio_test(labels, order, u, r, count)
            if not (full < np.inf or length < np.inf):
                if not gap <= _REDUNDANCY_TOL * W.value_roundoff[entering]:
                    return np.int64(-1), count
                W.next[entering] = 1
                break
            length = min(length, full)
            for i in range(count):
                u[i] = max(u[i] - length * r[i], 0.0) if labels[order[i]] != EQUALITY else u[i] - length * r[i]
            pushed += length
            if full < np.inf:
                for k in range(count, N):
                    add_multiple(v, length * d[k], J[k], N)
            if length == full:
                add_constraint(R, J, d, w, count)
                equal = P.lower[entering] == P.upper[entering]
                labels[entering] = EQUALITY if equal else AT_LOWER if side > 0.0 else AT_UPPER
                order[count], u[count] = entering, pushed
                count += 1
                break
            drop_constraint(R, J, leaving, count)
            labels[order[leaving]] = INACTIVE
            for i in range(leaving, count - 1):
                order[i], u[i] = order[i + 1], u[i + 1]
            count -= 1
