"""What counts as no violation and as no multiplier at a point of one weighted QP.

As ``constraint_scales`` in ``solvers/qp/_problem.py``, which is invariant to the units of the variables.
"""

from __future__ import annotations

import numpy as np

from ._dense import add_multiple_absolute, dot_absolute
from ._frame import lean
from ._qp_active_set_solve import EPS

_NOUGHT = 100.0
"""Roundings of what the cost pulls at x; an x that is no larger is 0."""
_TOLD_FROM_NONE = 1.0
"""Roundings of the terms at a variable on a bound; a multiplier of the wrong sign that is larger lets it go.

Tolerances of the cost's curvature would not do: a weak task, such as a posture, pulls with less than those."""


@lean
def find_roundoff(P, W, tolerance, x, z):
    """Of each constraint, ``tolerance`` of the scale of its value and of its multiplier."""
    m, n = len(P.target), len(x)
    most, pulled_most = 0.0, 0.0
    for j in range(n):
        root, gradient = P.root[j], W.gradient[j]
        for i in range(m, len(P.compliance)):
            gradient += P.rows[i, j] * z[i]
        W.step[j] = abs(gradient) / (root * root)
        most, pulled_most = max(most, abs(x[j]) * root), max(pulled_most, W.step[j] * root)
    if most <= _NOUGHT * EPS * pulled_most:
        most = pulled_most
    else:
        for j in range(n):
            W.step[j] = abs(x[j])
    longest = 0.0
    for j in range(n):
        longest = max(longest, W.step[j])
    for i in range(len(P.lower)):
        value, reach, span = 0.0, 0.0, 1.0
        if i < n:
            value, reach = x[i], 1.0 / P.root[i]
        else:
            span, row = 0.0, P.rows[m + i - n]
            for j in range(n):
                value += row[j] * x[j]
                span += abs(row[j])
                reach += abs(row[j]) / P.root[j]
        nearest = min(abs(P.lower[i]), abs(P.upper[i]))
        scale = min(most * reach, longest * span) + abs(value) + (nearest if nearest < np.inf else 0.0)
        W.value_roundoff[i] = tolerance * scale
        W.multiplier_roundoff[i] = tolerance * scale / max(reach, 1e-300) ** 2
    find_bound_roundoff(P, W, x, z)


@lean
def find_bound_roundoff(P, W, x, z):
    """Of each variable on a bound, what counts as no multiplier: rounding of the terms of its gradient."""
    m, n = len(P.target), len(x)
    for j in range(n):
        W.multiplier_roundoff[j] = _TOLD_FROM_NONE * EPS * P.damping[j] * (abs(x[j]) + abs(P.center[j]))
    for i in range(len(P.compliance)):
        size = abs(z[i]) if i >= m else abs(P.target[i]) + dot_absolute(P.rows[i], x, n)
        add_multiple_absolute(W.multiplier_roundoff, _TOLD_FROM_NONE * EPS * size, P.rows[i], n)
