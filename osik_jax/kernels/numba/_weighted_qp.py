"""Kernel of the weighted QP: working sets and their minimisers, one problem after another, each as long as it takes.

    min 1/2 sum_i weight_i (A x - target)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2 + 1/2 sum_q t_q^2 / compliance_q
    over lower <= [x; C x + t] <= upper

A lane solves on its working set and looks at the signs: bounds that are crossed become active, those whose multiplier
has the wrong sign become inactive, all at once (block pivoting). Where that stops helping, a dual active set begins
anew (``_goldfarb_idnani``), which cannot cycle. Whatever comes of it is a candidate, which JAX certifies. No candidate
comes of rows that cannot hold together, rows that depend on each other, and numbers that are none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...numerics._constants import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE
from ._dense import add_multiple, backward, cholesky, dot, fill, forward
from ._frame import arguments, data, dimension, is_call, lean, matrix, results, vector, whole_numbers
from ._goldfarb_idnani import dual_active_set

EPS = 2.220446049250313e-16
_NOUGHT = 100.0
"""Roundings of what the cost pulls at x; an x that is no larger is 0."""
_TOLD_FROM_NONE = 1.0
"""Roundings of the forces at a variable on a bound; a multiplier of the wrong sign that is larger lets it go.

Tolerances of the cost's curvature would not do: a weak task, such as a posture, pulls with less than those."""
_PATIENCE = 2
"""Exchanges that leave no fewer wrong signs, before the dual active set."""
_SMALLEST_PIVOT = 1e2
"""Roundings of its diagonal element; a smaller pivot says that rows depend on each other."""
_MOST_CORRECTIONS = 10
_LAST_CORRECTION = 1e-10
"""A correction by this share of x is the last."""
_WORTH = 0.25
"""A correction that is not this much smaller than the one before is rounding."""


class Problem(NamedTuple):
    """One problem, the roots of its weights multiplied in.

    Fields: ``rows`` [sqrt(W) A; C], (m + p, n). ``wanted`` sqrt(W) target, (m,). ``give`` ones, then the compliances,
    (m + p,). ``damping`` and ``center`` (n,). ``lower`` and ``upper`` (n + p,). ``diagonal`` of the Hessian, (n,).
    """

    rows: np.ndarray
    wanted: np.ndarray
    give: np.ndarray
    damping: np.ndarray
    center: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    diagonal: np.ndarray


class Work(NamedTuple):
    """Space for one problem, used again by the next; k = m + p rows, N = n + p constraints, q = max(n, k).

    Fields: ``square`` (q, q) a Cholesky factor. ``scaled`` (k, n) rows over the roots of the damping. ``held`` (p, n)
    and ``schur`` (p, p): rows of C behind the factor of the Hessian. ``used`` (k,) numbers of rows. ``right`` (q,).
    ``root``, ``step`` and ``slope`` (n,). ``value_noise`` and ``multiplier_noise`` (N,). ``next`` (N,) labels. The rest
    is the dual active set's: ``R``, ``J`` (N, N), ``point``, ``along``, ``reflected``, ``multipliers``, ``rates``,
    ``order`` (N,).
    """

    square: np.ndarray
    scaled: np.ndarray
    held: np.ndarray
    schur: np.ndarray
    R: np.ndarray
    J: np.ndarray
    right: np.ndarray
    root: np.ndarray
    step: np.ndarray
    slope: np.ndarray
    value_noise: np.ndarray
    multiplier_noise: np.ndarray
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
    """Fills in the problem: rows [sqrt(W) A; C] and the diagonal of A'WA + D."""
    m, n = A.shape
    p = C.shape[0]
    for j in range(n):
        P.diagonal[j] = P.damping[j]
    for i in range(m):
        root = np.sqrt(weight[i])
        P.wanted[i] = root * target[i]
        P.give[i] = 1.0
        for j in range(n):
            entry = root * A[i, j]
            P.rows[i, j] = entry
            P.diagonal[j] += entry * entry
    for q in range(p):
        P.give[m + q] = compliance[q]
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


@lean
def used_rows(P, labels, used):
    """Numbers of the rows of the working set: all of the cost, the active ones of C; how many they are."""
    m, n = len(P.wanted), len(P.damping)
    count = 0
    for i in range(len(P.give)):
        if i < m or labels[n + i - m] != INACTIVE:
            used[count] = i
            count += 1
    return count


@lean
def residual(P, labels, i, x, z):
    """Of row i of the working set: wanted - row x - give z, which is 0 at the minimiser."""
    m, n = len(P.wanted), len(x)
    wanted = P.wanted[i] if i < m else active_bound(P, labels[n + i - m], n + i - m)
    return wanted - dot(P.rows[i], x, 0, n) - P.give[i] * z[i]


@lean
def solve_in_row_space(P, W, labels, count, x, z):
    """Solves on the working set through a system as large as its rows (Sherman, Morrison, Woodbury).

    With z the residuals of the rows of the cost and the multipliers of those of C, E = diag(give), the optimality
    conditions D (x - center) = B'z over the free variables and B x + E z = wanted give

        S z = wanted - B x0,    x_F = center_F + D_F^-1 B_F'z,    S = B_F D_F^-1 B_F' + E,

    where x0 is the center, and the bound where a variable is active: there nothing large cancels. Corrections are for
    what x and z leave, -slope and gap: S dz = gap - B D^-1 (-slope), dx = D^-1 (-slope + B'dz).
    """
    m, n, k = len(P.wanted), len(x), count
    for j in range(n):
        free = labels[j] == INACTIVE
        x[j] = P.center[j] if free else active_bound(P, labels[j], j)
        W.root[j] = 1.0 / np.sqrt(P.damping[j]) if free else 0.0
        W.step[j] = 0.0
    for a in range(k):
        row, scaled = P.rows[W.used[a]], W.scaled[a]
        for j in range(n):
            scaled[j] = row[j] * W.root[j]
        for b in range(a + 1):
            W.square[a, b] = dot(scaled, W.scaled[b], 0, n)
        W.square[a, a] += P.give[W.used[a]]
        z[W.used[a]] = 0.0
        W.right[a] = residual(P, labels, W.used[a], x, z)
    if not cholesky(W.square, k, _SMALLEST_PIVOT * EPS):
        return False
    before = np.inf
    for _ in range(_MOST_CORRECTIONS):
        forward(W.square, W.right, k)
        backward(W.square, W.right, k)
        for a in range(k):
            z[W.used[a]] += W.right[a]
            add_multiple(W.step, W.right[a], W.scaled[a], n)
        moved, far = 0.0, 0.0
        for j in range(n):
            step, root = W.root[j] * W.step[j], np.sqrt(P.diagonal[j])
            x[j] += step
            moved, far = max(moved, abs(step) * root), max(far, abs(x[j]) * root)
        if before < np.inf and (moved <= _LAST_CORRECTION * far or moved > _WORTH * before):
            break
        before = moved
        slope_of(P, W, labels, x, z)
        for j in range(n):
            W.step[j] = -W.root[j] * W.slope[j]
        for a in range(k):
            gap = 0.0 if a < m else residual(P, labels, W.used[a], x, z)
            W.right[a] = gap - dot(W.scaled[a], W.step, 0, n)
    return True


@lean
def factor_hessian(P, W, labels, count):
    """Factors of H_F = B_F'B_F + D_F, with B the rows of the cost, and of what the active rows of C leave behind it.

    L L' = H_F in ``square``, V = L^-1 C_F' in the rows of ``held``, and the Schur complement V'V + E in ``schur``.
    Active variables have a row and a column of the identity.
    """
    m, n = len(P.wanted), len(P.damping)
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
        row, held = P.rows[W.used[m + a]], W.held[a]
        for j in range(n):
            held[j] = row[j] if labels[j] == INACTIVE else 0.0
        forward(W.square, held, n)
        for b in range(a + 1):
            W.schur[a, b] = dot(held, W.held[b], 0, n)
        W.schur[a, a] += P.give[W.used[m + a]]
    return cholesky(W.schur, count - m, _SMALLEST_PIVOT * EPS)


@lean
def solve_by_hessian(P, W, labels, count, x, z):
    """Solves on the working set through a system as large as x; for more rows than variables.

    H_F dx - C_F'dy = slope and C_F dx + E dy = gap are solved, again and again, for what x and y leave of the
    optimality conditions: dy = (V'V + E)^-1 (gap - V'L^-1 slope), dx = L'^-1 (L^-1 slope + V dy).
    """
    m, n, p = len(P.wanted), len(x), count - len(P.wanted)
    if not factor_hessian(P, W, labels, count):
        return False
    for j in range(n):
        x[j] = 0.0 if labels[j] == INACTIVE else active_bound(P, labels[j], j)
    for a in range(p):
        z[W.used[m + a]] = 0.0
    before = np.inf
    for _ in range(_MOST_CORRECTIONS):
        slope_of(P, W, labels, x, z)
        for j in range(n):
            W.step[j] = -W.slope[j] if labels[j] == INACTIVE else 0.0
        forward(W.square, W.step, n)
        for a in range(p):
            W.right[a] = residual(P, labels, W.used[m + a], x, z) - dot(W.held[a], W.step, 0, n)
        forward(W.schur, W.right, p)
        backward(W.schur, W.right, p)
        for a in range(p):
            z[W.used[m + a]] += W.right[a]
            add_multiple(W.step, W.right[a], W.held[a], n)
        backward(W.square, W.step, n)
        moved, far = 0.0, 0.0
        for j in range(n):
            root = np.sqrt(P.diagonal[j])
            x[j] += W.step[j]
            moved, far = max(moved, abs(W.step[j]) * root), max(far, abs(x[j]) * root)
        if before < np.inf and (moved <= _LAST_CORRECTION * far or moved > _WORTH * before):
            break
        before = moved
    return True


@lean
def slope_of(P, W, labels, x, z):
    """The slope D (x - center) - B'(wanted - B x) - C'y of the Lagrangian; the residuals of the cost go into z."""
    m, n = len(P.wanted), len(x)
    for j in range(n):
        W.slope[j] = P.damping[j] * (x[j] - P.center[j])
    for i in range(len(P.give)):
        if i < m:
            z[i] = P.wanted[i] - dot(P.rows[i], x, 0, n)
        if i < m or labels[n + i - m] != INACTIVE:
            add_multiple(W.slope, -z[i], P.rows[i], n)


@lean(inline="always")
def solve_on(P, W, labels, x, z):
    """The minimiser with the active constraints as equalities and the others left out, by the smaller system.

    Returns whether its factors are worth something; the slope is that of the Lagrangian at the minimiser.
    """
    count = used_rows(P, labels, W.used)
    few = count <= len(x)
    sound = solve_in_row_space(P, W, labels, count, x, z) if few else solve_by_hessian(P, W, labels, count, x, z)
    slope_of(P, W, labels, x, z)
    return sound


@lean
def measure_noise(P, W, tolerance, x, z):
    """Of each constraint, what counts as no violation and as no multiplier: ``tolerance`` of its scale.

    As ``constraint_scales`` in ``solvers/qp/_problem.py``, which is invariant to the units of the variables.
    """
    m, n = len(P.wanted), len(x)
    most, pulled_most = 0.0, 0.0
    for j in range(n):
        root, gradient = np.sqrt(P.diagonal[j]), W.slope[j]
        for i in range(m, len(P.give)):
            gradient += P.rows[i, j] * z[i]
        W.step[j] = abs(gradient) / P.diagonal[j]
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
            value, reach = x[i], 1.0 / np.sqrt(P.diagonal[i])
        else:
            span, row = 0.0, P.rows[m + i - n]
            for j in range(n):
                value += row[j] * x[j]
                span += abs(row[j])
                reach += abs(row[j]) / np.sqrt(P.diagonal[j])
        nearest = min(abs(P.lower[i]), abs(P.upper[i]))
        scale = min(most * reach, longest * span) + abs(value) + (nearest if nearest < np.inf else 0.0)
        W.value_noise[i] = tolerance * scale
        W.multiplier_noise[i] = tolerance * scale / max(reach, 1e-300) ** 2
    measure_forces(P, W, x, z)


@lean
def measure_forces(P, W, x, z):
    """Of each variable on a bound, what counts as no multiplier: rounding of what pulls at it, none against another."""
    m, n = len(P.wanted), len(x)
    for j in range(n):
        W.multiplier_noise[j] = _TOLD_FROM_NONE * EPS * P.damping[j] * (abs(x[j]) + abs(P.center[j]))
    for i in range(len(P.give)):
        size, row = abs(z[i]), P.rows[i]
        if i < m:
            size = abs(P.wanted[i])
            for j in range(n):
                size += abs(row[j] * x[j])
        for j in range(n):
            W.multiplier_noise[j] += _TOLD_FROM_NONE * EPS * size * abs(row[j])


@lean
def wanted_label(P, W, labels, i, x, z):
    """What constraint i should be: active where it is violated, inactive where its multiplier has the wrong sign."""
    m, n = len(P.wanted), len(x)
    if labels[i] == EQUALITY:
        return EQUALITY
    if labels[i] == INACTIVE:
        if P.lower[i] == P.upper[i]:
            return EQUALITY
        value = x[i] if i < n else dot(P.rows[m + i - n], x, 0, n)
        if value < P.lower[i] - W.value_noise[i]:
            return AT_LOWER
        return AT_UPPER if value > P.upper[i] + W.value_noise[i] else INACTIVE
    multiplier = W.slope[i] if i < n else z[m + i - n]
    return INACTIVE if -labels[i] * multiplier < -W.multiplier_noise[i] else labels[i]


@lean(inline="always")
def search(P, W, labels, tolerance, most_changes, x, z, report):
    """Working set and minimiser of one problem: block pivoting from the guess, then the dual active set.

    Args:
        P: the problem.
        W: space.
        labels: the guess; the working set at the end. (n + p,)
        tolerance: violation that counts as none, relative to the scale of the constraint.
        most_changes: cap on changes of the working set.
        x: the minimiser. (n,)
        z: multipliers of the rows. (m + p,)
        report: whether there is a candidate, changes, systems factored. (3,)
    """
    best, lives, cold, found = len(labels) + 1, _PATIENCE, False, False
    while True:
        report[2] += 1
        sound = solve_on(P, W, labels, x, z)
        if found or (cold and not sound):
            report[0] = sound and found
            return
        if sound:
            measure_noise(P, W, tolerance, x, z)
        if cold:
            steps = dual_active_set(P, W, labels, x, most_changes - report[1])
            if steps < 0:
                return
            report[1] += steps
            found = True
            continue
        wrong = 0
        for i in range(len(labels)):
            W.next[i] = wanted_label(P, W, labels, i, x, z)
            wrong += W.next[i] != labels[i]
        if sound and wrong == 0:
            report[0] = 1
            return
        lives = _PATIENCE if wrong < best else lives - 1
        best = min(best, wrong)
        cold = not sound or lives < 0
        for i in range(len(labels)):
            pinned = i < len(x) and P.lower[i] == P.upper[i]
            labels[i] = W.next[i] if not cold else EQUALITY if pinned else INACTIVE
        report[1] += 0 if cold else wrong


def handle(frame):
    """One call of XLA: arguments as in ``solvers/qp/_numba.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, n, p = dimension(found, 0), dimension(found, 8), dimension(found + 8, 8)
    whole = dimension(given, 8)  # numbers of a problem: (m + 2) rows of n and 2 m, p rows of n and p, 2 (n + p)
    m = (whole - 4 * n - p * n - 3 * p) // (n + 2)
    guess, tolerance, most = data(given + 8), data(given + 16), data(given + 24)
    solution, multipliers, active = data(found), data(found + 8), data(found + 16)
    report, space = data(found + 24), data(found + 32)
    k, N, q = m + p, n + p, max(n, m + p)
    rows, at = matrix(space, k, n), space + 8 * k * n
    square, at = matrix(at, q, q), at + 8 * q * q
    scaled, at = matrix(at, k, n), at + 8 * k * n
    held, at = matrix(at, p, n), at + 8 * p * n
    schur, at = matrix(at, p, p), at + 8 * p * p
    R, at = matrix(at, N, N), at + 8 * N * N
    J, at = matrix(at, N, N), at + 8 * N * N
    line = 8 * (q + N)
    W = Work(
        square, scaled, held, schur, R, J, vector(at, q), vector(at + line, n), vector(at + 2 * line, n),
        vector(at + 3 * line, n), vector(at + 4 * line, N), vector(at + 5 * line, N), vector(at + 6 * line, N),
        vector(at + 7 * line, N), vector(at + 8 * line, N), vector(at + 9 * line, N), vector(at + 10 * line, N),
        whole_numbers(at + 11 * line, k), whole_numbers(at + 12 * line, N), whole_numbers(at + 13 * line, N),
    )  # fmt: skip
    at += 14 * line
    wanted, give, diagonal, z = vector(at, m), vector(at + line, k), vector(at + 2 * line, n), vector(at + 3 * line, k)
    for lane in range(lanes):
        first, last, A = 8 * n * lane, 8 * N * lane, data(given) + 8 * whole * lane
        target = A + 8 * m * n
        damping = target + 16 * m
        C = damping + 16 * n
        lower = C + 8 * (p * n + p)
        P = Problem(
            rows, wanted, give, vector(damping, n), vector(damping + 8 * n, n), vector(lower, N),
            vector(lower + 8 * N, N), diagonal,
        )  # fmt: skip
        x, labels = vector(solution + first, n), whole_numbers(active + last // 2, N)
        said, guessed = whole_numbers(report + 12 * lane, 3), whole_numbers(guess + last // 2, N)
        begin(
            P, matrix(A, m, n), vector(target, m), vector(target + 8 * m, m), matrix(C, p, n),
            vector(C + 8 * p * n, p),
        )  # fmt: skip
        first_labels(P, guessed, labels)
        for i in range(3):
            said[i] = 0
        fill(z, 0.0)
        search(P, W, labels, vector(tolerance, lanes)[lane], whole_numbers(most, 1)[0], x, z, said)
        if said[0] == 0:
            first_labels(P, guessed, labels)
        y = vector(multipliers + 8 * p * lane, p)
        for j in range(p):
            y[j] = z[m + j] if labels[n + j] != INACTIVE else 0.0
    return 0
