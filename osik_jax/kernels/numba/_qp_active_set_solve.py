"""The minimiser on an active set, by the smaller of two systems: through the rows, or through the Hessian.

Both are solved again and again for what the point leaves of the optimality conditions, until that is rounding.
``solvers/qp/_row_space.py`` and ``_kkt_solve.py`` have the same systems in plain JAX.
"""

from __future__ import annotations

import numpy as np

from ...numerics._constants import EPSILON, INACTIVE, KERNEL_CORRECTION, KERNEL_PIVOT, KERNEL_REFINEMENTS, MIN_DECREASE
from ._dense import add_multiple, backward, cholesky, dot, forward
from ._frame import lean
from ._padded_rows import (
    clear,
    largest_product,
    minus_rows,
    put,
    put_damping_gradient,
    put_difference,
    put_inverse,
    put_multiple,
    put_product,
)
from ._qp_problem import active_bound
from ._symmetric import factor_symmetric, solve_symmetric
from ._tiles import padded, take_product
from ._vectors import WIDTH

_MAX_REFINEMENTS = KERNEL_REFINEMENTS[np.dtype("float64")]


@lean(inline="always")
def solve_on_active_set(P, W, labels, x, z):
    """Return the minimiser with the active constraints as equalities and the others left out, by the smaller system.

    Returns whether its factors are worth something; the gradient is that of the Lagrangian at the minimiser.

    Args:
        P: the problem.
        W: space.
        labels: the active set. (n + p,)
        x: the minimiser. (n,)
        z: residuals of the rows of the cost, multipliers of those of C. (m + p,)
    """
    count = find_used_rows(P, labels, W.used, z)
    few = count <= len(x)
    return solve_in_row_space(P, W, labels, count, x, z) if few else solve_by_hessian(P, W, labels, count, x, z)


@lean
def find_used_rows(P, labels, used, z):
    """Find the rows of the active set, all of the cost and the active ones of C; return how many. Others have z 0."""
    m, n = len(P.target), len(P.damping)
    count = 0
    for i in range(len(P.compliance)):
        if i < m or labels[n + i - m] != INACTIVE:
            used[count] = i
            count += 1
        else:
            z[i] = 0.0
    return count


@lean
def gap_of(P, labels, i, x, z):
    """Return target - row x - compliance z of row i of the active set, which is 0 at the minimiser."""
    m, n = len(P.target), len(x)
    target = P.target[i] if i < m else active_bound(P, labels[n + i - m], n + i - m)
    return target - dot(P.rows[i], x, 0, n) - P.compliance[i] * z[i]


@lean(inline="always")
def find_gaps(P, W, labels, x, z):
    """Find target - row x of each row of the cost, and target - row x - compliance z of each of C, 0 where active."""
    m, n, rows = len(P.target), len(x), len(P.compliance)
    minus_rows(W.gap, P.goal, x, P.turned, 0, n, 0, padded(rows))
    for i in range(m, rows):
        W.gap[i] += active_bound(P, labels[n + i - m], n + i - m) - P.compliance[i] * z[i]


@lean(inline="always")
def find_gradient(P, W, labels, x, z):
    """Find the gradient D (x - center) - B'(target - B x) - C'y of the Lagrangian; residuals of the cost go into z."""
    m, n, rows = len(P.target), len(x), len(P.compliance)
    if m == rows:
        minus_rows(z, P.goal, x, P.turned, 0, n, 0, padded(rows))
    else:
        find_gaps(P, W, labels, x, z)
        for i in range(m):
            z[i] = W.gap[i]
    put_damping_gradient(W.gradient, P.damping, x, P.center, padded(n))
    minus_rows(W.gradient, W.gradient, z, P.rows, 0, rows, 0, padded(n))


@lean
def put_columns_of_used(P, W, count, n):
    """Put the columns of the rows of the active set, one after another, each as long as these are many."""
    for j in range(n):
        for a in range(count):
            W.columns[j, a] = P.turned[j, W.used[a]]
        for a in range(count, padded(count)):
            W.columns[j, a] = 0.0


@lean(inline="always")
def solve_in_row_space(P, W, labels, count, x, z):
    """Solves on the active set through a system as large as its rows (Sherman, Morrison, Woodbury).

    With z the residuals of the rows of the cost and the multipliers of those of C, E = diag(compliance), the optimality
    conditions D (x - center) = B'z over the free variables and B x + E z = target give

        S z = target - B x0,    x_F = center_F + D_F^-1 B_F'z,    S = B_F D_F^-1 B_F' + E,

    where x0 is the center, and the bound where a variable is active: there nothing large cancels. Corrections are for
    what x and z leave, gradient and gap: S dz = gap + B D^-1 gradient, dx = -D^-1 (gradient - B'dz).
    """
    m, n, k, rows = len(P.target), len(x), count, len(P.compliance)
    width, wide, all_used = padded(k), padded(n), count == len(P.compliance)
    put_inverse(W.inverse, P.damping, wide)
    put(x, P.center, wide)
    for j in range(n):
        if labels[j] != INACTIVE:
            x[j], W.inverse[j] = active_bound(P, labels[j], j), 0.0
    if not all_used:
        put_columns_of_used(P, W, k, n)
    columns = P.turned if all_used else W.columns
    clear(z, padded(rows))
    find_gaps(P, W, labels, x, z)
    for a in range(k):
        W.right[a] = W.gap[W.used[a]]
    for j in range(n):
        put_multiple(W.scaled[j], -W.inverse[j], columns[j], width)
    for a in range(0, k, WIDTH):
        for i in range(a, a + WIDTH):
            clear(W.gram[i], width)
        take_product(W.gram, W.scaled, columns, a, min(a + WIDTH, k), a, width, 0, n)
    for a in range(k):
        W.gram[a, a] += P.compliance[W.used[a]]
    if not factor_symmetric(W.gram, W.factor, W.turned_factor, W.pivots, W.solved, k, KERNEL_PIVOT * EPSILON):
        return False
    clear(W.gradient, wide)
    before = np.inf
    for _ in range(_MAX_REFINEMENTS):
        solve_symmetric(W.factor, W.turned_factor, W.pivots, W.right, k)
        clear(W.row_terms, padded(rows))
        for a in range(k):
            z[W.used[a]] += W.right[a]
            W.row_terms[W.used[a]] = W.right[a]
        minus_rows(W.step, W.gradient, W.row_terms, P.rows, 0, rows, 0, wide)
        put_product(W.step, W.step, W.inverse, wide)
        put_difference(x, x, W.step, wide)
        moved, far = largest_product(W.step, P.root, wide), largest_product(x, P.root, wide)
        find_gradient(P, W, labels, x, z)
        if before < np.inf and (moved <= KERNEL_CORRECTION * far or moved > MIN_DECREASE * before):
            break
        before = moved
        clear(W.right, width)
        for a in range(m, k):
            W.right[a] = W.gap[W.used[a]]
        minus_rows(W.right, W.right, W.gradient, W.scaled, 0, n, 0, width)
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
    if not cholesky(W.square, n, EPSILON):
        return False
    for a in range(count - m):
        row, reduced = P.rows[W.used[m + a]], W.reduced[a]
        for j in range(n):
            reduced[j] = row[j] if labels[j] == INACTIVE else 0.0
        forward(W.square, reduced, n)
        for b in range(a + 1):
            W.schur[a, b] = dot(reduced, W.reduced[b], 0, n)
        W.schur[a, a] += P.compliance[W.used[m + a]]
    return cholesky(W.schur, count - m, KERNEL_PIVOT * EPSILON)


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
    before, last = np.inf, False
    for round in range(_MAX_REFINEMENTS + 1):
        find_gradient(P, W, labels, x, z)
        if last or round == _MAX_REFINEMENTS:
            break
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
        last = before < np.inf and (moved <= KERNEL_CORRECTION * far or moved > MIN_DECREASE * before)
        before = moved
    return True
