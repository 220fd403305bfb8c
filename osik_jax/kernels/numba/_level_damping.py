"""The damping of one level and the box that it leaves to the levels below: ``solvers/_damping.py`` in the kernel."""

from __future__ import annotations

from math import sqrt

from ...numerics._constants import (
    COST_FRACTION,
    DAMPING_ITERATIONS,
    DAMPING_RIDGE,
    MIN_RADIUS,
    NEGLIGIBLE_CURVATURE,
    NEGLIGIBLE_DAMPING,
)
from . import _level_workspace as ws
from ._frame import lean
from ._level_factors import cholesky, cholesky_solve, from_basis, gram, rows_in_basis, to_basis
from ._level_workspace import clear, clip, copy, target
from ._vectors import add, dot


@lean
def level_damping(F, J, s, constant):
    """Return ``constant + unmet ratio``, with the ratio of the demand that the step with this very damping misses.

    It is the fixed point of ``level_damping`` in ``solvers/_damping.py``, from the ratio 1 downwards; 0 where its
    forces would be roundoff.
    """
    A = F[s.A : s.A + s.rows]
    R = F[s.R : s.R + s.rows]
    n, m, least = s.n, s.rows, NEGLIGIBLE_DAMPING * s.longest_square
    damping = constant
    if s.unmet > least:
        ratio, before = 1.0, 0.0
        # base: x without its components in the columns that are not frozen
        to_basis(F, J, s, s.first_active, F[ws.X], F[ws.WORK])
        from_basis(F, J, s, s.first_active, n, F[ws.STEP])
        base, end = F[ws.START], F[ws.STEP]
        for i in range(n):
            base[i] = F[ws.X, i] - F[ws.STEP, i]
        goal = F[ws.RATE]
        for a in range(m):
            value = dot(A[a], base, 0, n)
            goal[a] = target(F, J, a, value) - value
            J[ws.IN_COST, a] = J[ws.EQUALITY, a] != 0 or goal[a] != 0.0
        rows_in_basis(F, J, s, s.first_active)
        trace = gram(F, J, s, m, s.first_active)
        for _ in range(DAMPING_ITERATIONS):
            if ratio == before or not s.unmet * ratio > least:
                break
            before = ratio
            # the damped step d = R' (R R' + damping I)^-1 goal, clipped into the box
            ridge = constant + s.unmet * ratio + DAMPING_RIDGE * trace
            cholesky(F, J, s, m, ridge if ridge > 0.0 else 1.0)
            copy(goal, F[ws.RIGHT], m)
            cholesky_solve(F, J, s, m, F[ws.RIGHT])
            clear(F[ws.WORK], s.first_active, n)
            for a in range(m):
                add(F[ws.WORK], F[ws.RIGHT, a], R[a], s.first_active, n)
            from_basis(F, J, s, s.first_active, n, end)
            for i in range(n):
                end[i] = clip(base[i] + end[i], F[ws.HARD_LOWER, i], F[ws.HARD_UPPER, i])
            square = 0.0
            for a in range(m):
                value = dot(A[a], end, 0, n)
                square += (value - target(F, J, a, value)) ** 2
            ratio = min(sqrt(square) / (s.demand if s.demand > 0.0 else 1.0), 1.0)
        damping = constant + s.unmet * ratio
    return damping if damping > least else 0.0


@lean
def narrow_box(F, J, s, bends):
    """Narrow the box for the levels below to what they may spend of the progress of a level that is out of reach.

    It is ``narrow_box`` of ``solvers/_damping.py``: a motion d costs up to ``1/2 missed size sum_j c_j d_j^2``, with
    the curvature c of the rows along each variable.
    """
    n = s.n
    missed = min(s.slack_norm, s.demand)
    ratio = missed / (s.demand if s.demand > 0.0 else 1.0)
    largest, count = 0.0, 0
    for i in range(n):
        F[ws.CURVATURE, i] = max(F[ws.CURVATURE, i], bends[i] / (s.frobenius if s.frobenius > 0.0 else 1.0))
        largest = max(largest, missed * s.frobenius * F[ws.CURVATURE, i])
    if not s.unmet * ratio > NEGLIGIBLE_DAMPING * s.longest_square:
        return
    for i in range(n):
        count += missed * s.frobenius * F[ws.CURVATURE, i] > NEGLIGIBLE_CURVATURE * largest
    # each variable that counts may spend an equal part of the level's gain 1/2 (demand^2 - missed^2)
    gain = COST_FRACTION * (s.demand - missed) * (s.demand + missed)
    for i in range(n):
        cost = missed * s.frobenius * F[ws.CURVATURE, i]
        if cost > NEGLIGIBLE_CURVATURE * largest:
            room = sqrt(gain / (count * cost)) + MIN_RADIUS
            F[ws.HARD_LOWER, i] = max(F[ws.HARD_LOWER, i], F[ws.X, i] - room)
            F[ws.HARD_UPPER, i] = min(F[ws.HARD_UPPER, i], F[ws.X, i] + room)
