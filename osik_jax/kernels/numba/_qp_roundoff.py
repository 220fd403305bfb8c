"""What counts as no violation and as no multiplier at a point of one weighted QP.

As ``constraint_scales`` in ``solvers/qp/_problem.py``, which is invariant to the units of the variables.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import BOUND_MULTIPLIER, EPSILON, INACTIVE, ZERO_TOL
from ._frame import lean
from ._padded_rows import clear, largest_product, plus_sizes
from ._tiles import padded


@lean(inline="always")
def find_roundoff(P, W, labels, tolerance, x, z):
    """Find the roundoff of each constraint, ``tolerance`` times the scale of its value and, if active, multiplier."""
    m, n = len(P.target), len(x)
    wide = padded(n)
    for j in range(n):
        gradient = W.gradient[j]
        for i in range(m, len(P.compliance)):
            gradient += P.rows[i, j] * z[i]
        W.step[j] = abs(gradient) * (P.inverse_root[j] * P.inverse_root[j])
    most, newton_most = largest_product(x, P.root, wide), largest_product(W.step, P.root, wide)
    longest = largest_product(x, W.ones, wide)
    if most <= ZERO_TOL * EPSILON * newton_most:
        most, longest = newton_most, largest_product(W.step, W.ones, wide)
    at_bound = False
    for j in range(n):
        nearest = min(abs(P.lower[j]), abs(P.upper[j]))
        scale = min(most * P.inverse_root[j], longest) + abs(x[j]) + (nearest if nearest < np.inf else 0.0)
        W.value_roundoff[j] = tolerance * scale
        at_bound = at_bound or labels[j] != INACTIVE
    for i in range(n, len(P.lower)):
        value, per_curvature, per_unit, row = 0.0, 0.0, 0.0, P.rows[m + i - n]
        for j in range(n):
            value += row[j] * x[j]
            per_unit += abs(row[j])
            per_curvature += abs(row[j]) * P.inverse_root[j]
        nearest = min(abs(P.lower[i]), abs(P.upper[i]))
        scale = min(most * per_curvature, longest * per_unit) + abs(value) + (nearest if nearest < np.inf else 0.0)
        W.value_roundoff[i] = tolerance * scale
        W.multiplier_roundoff[i] = tolerance * scale / max(per_curvature, 1e-300) ** 2
    if at_bound:
        find_bound_roundoff(P, W, x, z)


@lean
def find_bound_roundoff(P, W, x, z):
    """Find the roundoff of the multiplier of each variable on a bound: that of the terms of its gradient."""
    m, n, rows = len(P.target), len(x), len(P.compliance)
    clear(W.row_terms, padded(rows))
    plus_sizes(W.row_terms, W.row_terms, x, P.turned, 0, n, 0, padded(rows))
    for i in range(rows):
        size = abs(z[i]) if i >= m else abs(P.target[i]) + W.row_terms[i]
        W.row_terms[i] = BOUND_MULTIPLIER * EPSILON * size
    for j in range(n):
        W.step[j] = BOUND_MULTIPLIER * EPSILON * P.damping[j] * (abs(x[j]) + abs(P.center[j]))
    plus_sizes(W.step, W.step, W.row_terms, P.rows, 0, rows, 0, padded(n))
    for j in range(n):
        W.multiplier_roundoff[j] = W.step[j]
