"""The search for the active set of one weighted QP: block pivoting from a guess, then the dual active-set method."""

from __future__ import annotations

import numpy as np

from ...numerics._constants import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, MAX_DUAL_STARTS, MAX_EXCHANGES, REDUNDANT
from ._dense import dot
from ._frame import lean
from ._goldfarb_idnani import dual_active_set
from ._qp_active_set_solve import solve_on_active_set
from ._qp_roundoff import find_roundoff


@lean(inline="always")
def search(P, W, labels, tolerance, most_changes, x, z, report):
    """Find active set and minimiser of one problem.

    Args:
        P: the problem.
        W: space.
        labels: the guess; the active set at the end. (n + p,)
        tolerance: violation that counts as none, relative to the scale of the constraint.
        most_changes: limit on changes of the active set.
        x: the minimiser. (n,)
        z: multipliers of the rows. (m + p,)
        report: whether there is a candidate, changes, systems factored. (3,)
    """
    best, lives, cold, times, active_count = len(labels) + 1, MAX_EXCHANGES, False, 0, np.int64(-1)
    while True:
        report[2] += 1
        is_regular = solve_on_active_set(P, W, labels, x, z)
        if cold and not is_regular:
            return
        if is_regular:
            find_roundoff(P, W, labels, tolerance, x, z)
        if times > 0 and (times == MAX_DUAL_STARTS or not leaves_out(P, W, labels, x, z)):
            report[0] = 1
            for i in range(len(labels)):
                labels[i] = REDUNDANT if W.next[i] != 0 else labels[i]
            return
        if cold:
            steps, active_count = dual_active_set(P, W, labels, x, z, active_count, most_changes - report[1])
            if steps < 0:
                return
            report[1] += steps
            times += 1
            continue
        wrong = 0
        for i in range(len(labels)):
            W.next[i] = right_label(P, W, labels, i, x, z)
            wrong += W.next[i] != labels[i]
        if is_regular and wrong == 0:
            report[0] = 1
            return
        lives = MAX_EXCHANGES if wrong < best else lives - 1
        best = min(best, wrong)
        cold = not is_regular or lives < 0
        for i in range(len(labels)):
            pinned = i < len(x) and P.lower[i] == P.upper[i]
            labels[i] = W.next[i] if not cold else EQUALITY if pinned else INACTIVE
        report[1] += 0 if cold else wrong


@lean
def leaves_out(P, W, labels, x, z):
    """Return whether a constraint is violated that is inactive, and not redundant beside the active ones."""
    for i in range(len(labels)):
        if labels[i] == INACTIVE and W.next[i] == 0 and right_label(P, W, labels, i, x, z) != INACTIVE:
            return True
    return False


@lean
def right_label(P, W, labels, i, x, z):
    """Return what constraint i should be: active where violated, inactive where its multiplier has the wrong sign."""
    m, n = len(P.target), len(x)
    if labels[i] == EQUALITY:
        return EQUALITY
    if labels[i] == INACTIVE:
        if P.lower[i] == P.upper[i]:
            return EQUALITY
        value = x[i] if i < n else dot(P.rows[m + i - n], x, 0, n)
        if value < P.lower[i] - W.value_roundoff[i]:
            return AT_LOWER
        return AT_UPPER if value > P.upper[i] + W.value_roundoff[i] else INACTIVE
    multiplier = W.gradient[i] if i < n else z[m + i - n]
    return INACTIVE if -labels[i] * multiplier < -W.multiplier_roundoff[i] else labels[i]
