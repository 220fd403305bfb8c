"""The minimiser of one level of a hierarchy on a working set, its multipliers, and the tolerances of its conditions.

These are the formulas of ``_working_set_solve.py`` in ``solvers/hqp``, in the coordinates of the basis.
"""

from __future__ import annotations

from math import isnan, sqrt

from ...numerics._constants import STATIONARITY_TOL
from . import _level_workspace as ws
from ._frame import lean
from ._level_factors import cholesky_solve, factor_active_rows, factor_level_rows, from_basis, to_basis
from ._level_workspace import clear, copy, hard_value, target
from ._vectors import add, dot


@lean
def least_squares_step(F, J, s):
    """Write the step d in the free columns that minimises ``1/2 |slack + A d|^2 + 1/2 damping |x + d|^2`` to STEP.

    Without damping, ``R d = -Q' slack`` in the pivots' columns. With it, ``x + d = R' y`` there, with
    ``(R R' + damping I) y = R x - Q' slack``.
    """
    R = F[s.R : s.R + s.rows]
    V = F[s.V : s.V + s.rows]
    n, m, y = s.n, s.rows, F[ws.RIGHT]
    for a in range(m):
        y[a] = -F[ws.SLACK, a] if J[ws.IN_COST, a] != 0 else 0.0
    # y = -Q' slack, a reflection after the other
    for k in range(s.rank):
        add(y, -F[ws.SCALE, k] * dot(V[k], y, k, m), V[k], k, m)
    if s.damping > 0.0:
        to_basis(F, J, s, s.first_free, F[ws.X], F[ws.DOWNHILL])
        for k in range(s.rank):
            y[k] += dot(R[k], F[ws.DOWNHILL], s.first_free, n)
        cholesky_solve(F, J, s, s.rank, y)
        for j in range(s.first_free, n):
            F[ws.WORK, j] = -F[ws.DOWNHILL, j]
        for k in range(s.rank):
            add(F[ws.WORK], y[k], R[k], s.first_free, n)
    else:
        # back substitution; columns that are no pivots stay 0
        clear(F[ws.WORK], s.first_free, n)
        for k in range(s.rank - 1, -1, -1):
            z = y[k] / R[k, J[ws.PIVOT, k]]
            F[ws.WORK, J[ws.PIVOT, k]] = z
            for b in range(k):
                y[b] -= R[b, J[ws.PIVOT, k]] * z
    from_basis(F, J, s, s.first_free, n, F[ws.STEP])


@lean
def restoring_step(F, J, s):
    """Write the shortest step that brings the active rows to their bounds to STEP.

    ``(N Z) t = bound - N x`` by substitution: N Z is lower triangular in the columns of the active rows.
    """
    Z = F[s.Z : s.Z + s.h]
    for k in range(s.first_free - s.first_active):
        q = J[ws.ACTIVE_ROW, k]
        bound = F[ws.HARD_LOWER, q] if J[ws.ACTIVE, q] < 0 else F[ws.HARD_UPPER, q]
        gap = bound - hard_value(F, J, s, q, F[ws.X])
        j = s.first_active + k
        F[ws.WORK, j] = (gap - dot(Z[q], F[ws.WORK], s.first_active, j)) / Z[q, j]
    from_basis(F, J, s, s.first_active, s.first_free, F[ws.STEP])


@lean
def multipliers(F, J, s):
    """Compute the multipliers of the active rows and the stationarity residual.

    With ``downhill = -Z' gradient``, ``sum_q N_q multiplier_q = -gradient`` holds in the active rows' columns, by
    substitution; the largest component of downhill in the free columns is the residual.
    """
    Z = F[s.Z : s.Z + s.h]
    A = F[s.A : s.A + s.rows]
    n = s.n
    gradient = F[ws.STEP]
    for i in range(n):
        gradient[i] = s.damping * F[ws.X, i]
    for a in range(s.rows):
        if J[ws.IN_COST, a] != 0:
            add(gradient, F[ws.SLACK, a], A[a], 0, n)
    s.gradient_norm = sqrt(dot(gradient, gradient, 0, n))
    to_basis(F, J, s, s.first_active, gradient, F[ws.DOWNHILL])
    s.residual = 0.0
    for j in range(s.first_active, n):
        F[ws.DOWNHILL, j] = -F[ws.DOWNHILL, j]
        if j >= s.first_free:
            s.residual = max(s.residual, abs(F[ws.DOWNHILL, j]))
        F[ws.WORK, j] = F[ws.DOWNHILL, j]
    clear(F[ws.MULTIPLIER], 0, s.h)
    for k in range(s.first_free - s.first_active - 1, -1, -1):
        q, j = J[ws.ACTIVE_ROW, k], s.first_active + k
        F[ws.MULTIPLIER, q] = F[ws.WORK, j] / Z[q, j]
        add(F[ws.WORK], -F[ws.MULTIPLIER, q], Z[q], s.first_active, j)


@lean
def evaluate(F, J, s):
    """Compute values and slacks of the level at x, their norm, and the root of twice its cost."""
    A = F[s.A : s.A + s.rows]
    n = s.n
    s.x_max = square = 0.0
    # a NaN has to arrive in x_max, which max() does not promise
    for i in range(n):
        s.x_max = F[ws.X, i] if isnan(F[ws.X, i]) else max(s.x_max, abs(F[ws.X, i]))
    for a in range(s.rows):
        F[ws.VALUE, a] = dot(A[a], F[ws.X], 0, n)
        F[ws.SLACK, a] = F[ws.VALUE, a] - target(F, J, a, F[ws.VALUE, a])
        square += F[ws.SLACK, a] ** 2
    s.slack_norm = sqrt(square)
    s.root_cost = sqrt(square + s.damping * dot(F[ws.X], F[ws.X], 0, n))


@lean
def gradient_roundoff(s):
    """Return the roundoff tolerance of the gradient: that of a slack, times the longest row."""
    return s.size * s.step_tol * (s.size * s.x_max + s.root_cost)


@lean
def sign_tolerance(s):
    """Return the force by which a multiplier has to be on the wrong side to have the wrong sign."""
    return s.multiplier_tol * s.gradient_norm + gradient_roundoff(s)


@lean
def is_stationary(s):
    """Check that what is left of the gradient in the free columns is roundoff."""
    return s.residual <= STATIONARITY_TOL * (s.multiplier_tol * s.size * s.root_cost + gradient_roundoff(s))


@lean
def working_set_slack(F, J, s):
    """Compute the slacks of the rows in the cost from the bound that the working set says they miss."""
    A = F[s.A : s.A + s.rows]
    for a in range(s.rows):
        bound = F[ws.UPPER, a] if J[ws.OWN, a] == 1 else F[ws.LOWER, a]
        F[ws.SLACK, a] = dot(A[a], F[ws.X], 0, s.n) - bound if J[ws.IN_COST, a] != 0 else 0.0


@lean
def solve_on_working_set(F, J, s):
    """Minimise the level's cost with active rows at their bounds and the rows of the working set in the cost."""
    copy(F[ws.START], F[ws.X], s.n)
    for a in range(s.rows):
        J[ws.IN_COST, a] = J[ws.OWN, a] != 0
    factor_active_rows(F, J, s)
    factor_level_rows(F, J, s)
    # the second time is a step of refinement against exact residuals
    for _ in range(2):
        restoring_step(F, J, s)
        add(F[ws.X], 1.0, F[ws.STEP], 0, s.n)
        working_set_slack(F, J, s)
        least_squares_step(F, J, s)
        add(F[ws.X], 1.0, F[ws.STEP], 0, s.n)
    evaluate(F, J, s)
    working_set_slack(F, J, s)
    s.root_cost = sqrt(dot(F[ws.SLACK], F[ws.SLACK], 0, s.rows) + s.damping * dot(F[ws.X], F[ws.X], 0, s.n))
