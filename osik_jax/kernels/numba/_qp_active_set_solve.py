"""The minimiser on an active set, by the smaller of two systems: through the rows, or through the Hessian.

Both are solved again and again for what the point leaves of the optimality conditions, until that is rounding.
``solvers/qp/_row_space.py`` and ``_kkt_solve.py`` have the same systems in plain JAX.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import INACTIVE
from ._dense import add_multiple, backward, cholesky, dot, forward, gram
from ._frame import lean
from ._qp_problem import active_bound

EPS = 2.220446049250313e-16
_SMALLEST_PIVOT = 1e2
"""Roundings of its diagonal element; a smaller pivot says that rows depend on each other."""
_MOST_CORRECTIONS = 10
_LAST_CORRECTION = 1e-10
"""A correction by this share of x is the last."""
_WORTH = 0.25
"""A correction that is not this much smaller than the one before is rounding."""


@lean(inline="always")
def solve_on_active_set(P, W, labels, x, z):
    """The minimiser with the active constraints as equalities and the others left out, by the smaller system.

    Returns whether its factors are worth something; the gradient is that of the Lagrangian at the minimiser.

    Args:
        P: the problem.
        W: space.
        labels: the active set. (n + p,)
        x: the minimiser. (n,)
        z: residuals of the rows of the cost, multipliers of those of C. (m + p,)
    """
    count = find_used_rows(P, labels, W.used)
    few = count <= len(x)
    sound = solve_in_row_space(P, W, labels, count, x, z) if few else solve_by_hessian(P, W, labels, count, x, z)
    find_gradient(P, W, labels, x, z)
    return sound


@lean
def find_used_rows(P, labels, used):
    """Numbers of the rows of the active set: all of the cost, the active ones of C; how many they are."""
    m, n = len(P.target), len(P.damping)
    count = 0
    for i in range(len(P.compliance)):
        if i < m or labels[n + i - m] != INACTIVE:
            used[count] = i
            count += 1
    return count


@lean
def gap_of(P, labels, i, x, z):
    """Of row i of the active set: target - row x - compliance z, which is 0 at the minimiser."""
    m, n = len(P.target), len(x)
    target = P.target[i] if i < m else active_bound(P, labels[n + i - m], n + i - m)
    return target - dot(P.rows[i], x, 0, n) - P.compliance[i] * z[i]


@lean
def find_gradient(P, W, labels, x, z):
    """The gradient D (x - center) - B'(target - B x) - C'y of the Lagrangian; residuals of the cost go into z."""
    m, n = len(P.target), len(x)
    for j in range(n):
        W.gradient[j] = P.damping[j] * (x[j] - P.center[j])
    for i in range(len(P.compliance)):
        if i < m:
            z[i] = P.target[i] - dot(P.rows[i], x, 0, n)
        if i < m or labels[n + i - m] != INACTIVE:
            add_multiple(W.gradient, -z[i], P.rows[i], n)


@lean
def solve_in_row_space(P, W, labels, count, x, z):
    """Solves on the active set through a system as large as its rows (Sherman, Morrison, Woodbury).

    With z the residuals of the rows of the cost and the multipliers of those of C, E = diag(compliance), the optimality
    conditions D (x - center) = B'z over the free variables and B x + E z = target give

        S z = target - B x0,    x_F = center_F + D_F^-1 B_F'z,    S = B_F D_F^-1 B_F' + E,

    where x0 is the center, and the bound where a variable is active: there nothing large cancels. Corrections are for
    what x and z leave, -gradient and gap: S dz = gap - B D^-1 (-gradient), dx = D^-1 (-gradient + B'dz).
    """
    m, n, k = len(P.target), len(x), count
    for j in range(n):
        free = labels[j] == INACTIVE
        x[j] = P.center[j] if free else active_bound(P, labels[j], j)
        W.inverse_root[j] = 1.0 / np.sqrt(P.damping[j]) if free else 0.0
        W.step[j] = 0.0
    for a in range(k):
        row, scaled = P.rows[W.used[a]], W.scaled[a]
        for j in range(n):
            scaled[j] = row[j] * W.inverse_root[j]
        z[W.used[a]] = 0.0
        W.right[a] = gap_of(P, labels, W.used[a], x, z)
    gram(W.scaled, W.square, k, n)
    for a in range(k):
        W.square[a, a] += P.compliance[W.used[a]]
    if not cholesky(W.square, k, _SMALLEST_PIVOT * EPS):
        return False
    before = np.inf
    for _ in range(_MOST_CORRECTIONS):
        forward(W.square, W.right, k)
        backward(W.square, W.right, k)
        for a in range(k):
            z[W.used[a]] += W.right[a]
            add_multiple(W.step, W.right[a], W.scaled[a], n)
        for j in range(n):
            W.step[j] *= W.inverse_root[j]
        moved, far = move(P, W, x)
        if before < np.inf and (moved <= _LAST_CORRECTION * far or moved > _WORTH * before):
            break
        before = moved
        find_gradient(P, W, labels, x, z)
        for j in range(n):
            W.step[j] = -W.inverse_root[j] * W.gradient[j]
        for a in range(k):
            gap = 0.0 if a < m else gap_of(P, labels, W.used[a], x, z)
            W.right[a] = gap - dot(W.scaled[a], W.step, 0, n)
    return True


@lean
def move(P, W, x):
    """Adds the step to x; the largest number of the step and of x, each in its unit."""
    moved, far = 0.0, 0.0
    for j in range(len(x)):
        x[j] += W.step[j]
        moved, far = max(moved, abs(W.step[j]) * P.root[j]), max(far, abs(x[j]) * P.root[j])
    return moved, far


@lean
def factor_hessian(P, W, labels, count):
    """Factors of H_F = B_F'B_F + D_F, with B the rows of the cost, and of what the active rows of C leave behind it.

    L L' = H_F in ``square``, V = L^-1 C_F' in the rows of ``reduced``, and the Schur complement V'V + E in ``schur``.
    Active variables have a row and a column of the identity.
    """
    m, n = len(P.target), len(P.damping)
    for a in range(n):
        for b in range(a + 1):
            W.square[a, b] = 0.0
    for i in range(m):
        row = P.rows[i]
        for a in range(n):
            if labels[a] == INACTIVE:
                add_multiple(W.square[a], row[a], row, a + 1)
    for a in range(n):
        if labels[a] == INACTIVE:
            W.square[a, a] += P.damping[a]
            for b in range(a):
                if labels[b] != INACTIVE:
                    W.square[a, b] = 0.0
        else:
            W.square[a, a] = 1.0
    if not cholesky(W.square, n, EPS):
        return False
    for a in range(count - m):
        row, reduced = P.rows[W.used[m + a]], W.reduced[a]
        for j in range(n):
            reduced[j] = row[j] if labels[j] == INACTIVE else 0.0
        forward(W.square, reduced, n)
        for b in range(a + 1):
            W.schur[a, b] = dot(reduced, W.reduced[b], 0, n)
        W.schur[a, a] += P.compliance[W.used[m + a]]
    return cholesky(W.schur, count - m, _SMALLEST_PIVOT * EPS)


@lean
def solve_by_hessian(P, W, labels, count, x, z):
    """Solves on the active set through a system as large as x; for more rows than variables.

    H_F dx - C_F'dy = -gradient and C_F dx + E dy = gap are solved, again and again, for what x and y leave of the
    optimality conditions: dy = (V'V + E)^-1 (gap + V'L^-1 gradient), dx = L'^-1 (-L^-1 gradient + V dy).
    """
    m, n, p = len(P.target), len(x), count - len(P.target)
    if not factor_hessian(P, W, labels, count):
        return False
    for j in range(n):
        x[j] = 0.0 if labels[j] == INACTIVE else active_bound(P, labels[j], j)
    for a in range(p):
        z[W.used[m + a]] = 0.0
    before = np.inf
    for _ in range(_MOST_CORRECTIONS):
        find_gradient(P, W, labels, x, z)
        for j in range(n):
            W.step[j] = -W.gradient[j] if labels[j] == INACTIVE else 0.0
        forward(W.square, W.step, n)
        for a in range(p):
            W.right[a] = gap_of(P, labels, W.used[m + a], x, z) - dot(W.reduced[a], W.step, 0, n)
        forward(W.schur, W.right, p)
        backward(W.schur, W.right, p)
        for a in range(p):
            z[W.used[m + a]] += W.right[a]
            add_multiple(W.step, W.right[a], W.reduced[a], n)
        backward(W.square, W.step, n)
        moved, far = move(P, W, x)
        if before < np.inf and (moved <= _LAST_CORRECTION * far or moved > _WORTH * before):
            break
        before = moved
    return True
