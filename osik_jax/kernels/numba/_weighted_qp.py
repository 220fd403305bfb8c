"""Kernel of the weighted QP: active sets and their minimisers, one problem after another, each as long as it takes.

    min 1/2 sum_i weight_i (A x - target)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2 + 1/2 sum_q t_q^2 / compliance_q
    over lower <= [x; C x + t] <= upper

A lane solves on its active set (``_qp_active_set_solve``) and looks at the signs: bounds that are crossed become
active, those whose multiplier has the wrong sign become inactive, all at once (block pivoting, ``_qp_search``). Where
that stops helping, the dual active-set method begins anew (``_goldfarb_idnani``), which cannot cycle. Whatever comes of
it is a candidate, which JAX certifies. No candidate comes of rows that cannot hold together, rows that depend
on each other, and numbers that are none.
"""

from __future__ import annotations

from ...numerics._constants import INACTIVE
from ._dense import fill
from ._frame import arguments, data, dimension, is_call, matrix, results, vector, whole_numbers
from ._qp_problem import Problem, Workspace, begin, first_labels
from ._qp_search import search


def handle(frame):
    """One call of XLA: arguments as in ``solvers/qp/_numba.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, n, p = dimension(found, 0), dimension(found, 8), dimension(found + 8, 8)
    m, rest = dimension(given, 8), dimension(given + 8, 8)  # rows of the matrix, numbers of a problem beside it
    guess, tolerance, most = data(given + 16), data(given + 24), data(given + 32)
    solution, multipliers, active = data(found), data(found + 8), data(found + 16)
    report, space = data(found + 24), data(found + 32)
    k, N, q = m + p, n + p, max(n, m + p)
    rows, at = matrix(space, k, n), space + 8 * k * n
    square, at = matrix(at, q, q), at + 8 * q * q
    scaled, at = matrix(at, k, n), at + 8 * k * n
    reduced, at = matrix(at, p, n), at + 8 * p * n
    schur, at = matrix(at, p, p), at + 8 * p * p
    R, at = matrix(at, N, N), at + 8 * N * N
    J, at = matrix(at, N, N), at + 8 * N * N
    line = 8 * (q + N)
    W = Workspace(
        square, scaled, reduced, schur, R, J, vector(at, q), vector(at + line, n), vector(at + 2 * line, n),
        vector(at + 3 * line, n), vector(at + 4 * line, N), vector(at + 5 * line, N), vector(at + 6 * line, N),
        vector(at + 7 * line, N), vector(at + 8 * line, N), vector(at + 9 * line, N), vector(at + 10 * line, N),
        whole_numbers(at + 11 * line, k), whole_numbers(at + 12 * line, N), whole_numbers(at + 13 * line, N),
    )  # fmt: skip
    at += 14 * line
    targets, compliances = vector(at, m), vector(at + line, k)
    root, z = vector(at + 2 * line, n), vector(at + 3 * line, k)
    for lane in range(lanes):
        first, last, A = 8 * n * lane, 8 * N * lane, data(given) + 8 * m * n * lane
        target = data(given + 8) + 8 * rest * lane
        damping = target + 16 * m
        C = damping + 16 * n
        lower = C + 8 * (p * n + p)
        P = Problem(
            rows, targets, compliances, vector(damping, n), vector(damping + 8 * n, n), vector(lower, N),
            vector(lower + 8 * N, N), root,
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
