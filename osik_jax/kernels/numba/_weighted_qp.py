"""Kernel of the weighted QP: active sets and their minimisers, one problem after another, each as long as it takes.

    min 1/2 sum_i weight_i (A x - target)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2 + 1/2 sum_q t_q^2 / compliance_q
    over lower <= [x; C x + t] <= upper

A lane solves on its active set (``_qp_active_set_solve``) and looks at the signs: bounds that are violated become
active, those whose multiplier has the wrong sign become inactive, all at once (block pivoting, ``_qp_search``). Where
that stops helping, the dual active-set method begins anew (``_goldfarb_idnani``), which cannot cycle, and goes on where
its end, solved anew, misses a bound. Whatever comes of it is a candidate, which JAX certifies. No candidate comes of
rows that cannot hold together, and numbers that are none.
"""

from __future__ import annotations

from ...numerics._constants import INACTIVE
from ._dense import fill
from ._frame import arguments, data, dimension, is_call, matrix, results, vector, whole_numbers
from ._padded_rows import put_multiple
from ._qp_problem import Problem, Workspace, begin, first_labels
from ._qp_search import search
from ._tiles import padded


def handle(frame):
    """Answer a call of XLA: arguments as in ``solvers/qp/_numba.py``, a leading axis of lanes on each."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, n, p = dimension(found, 0), dimension(found, 8), dimension(found + 8, 8)
    m, rest = dimension(given, 8), dimension(given + 8, 8)  # rows of the matrix, numbers of a problem beside it
    guess, tolerance, most = data(given + 16), data(given + 24), data(given + 32)
    solution, multipliers, active = data(found), data(found + 8), data(found + 16)
    report, space = data(found + 24), data(found + 32)
    k, N, q = m + p, n + p, max(n, m + p)
    wide, high, line = padded(n), padded(k), 8 * padded(q + N)
    rows, at = matrix(space, high, wide), space + 8 * high * wide
    turned, at = matrix(at, wide, high), at + 8 * wide * high
    columns, at = matrix(at, wide, high), at + 8 * wide * high
    scaled, at = matrix(at, wide, high), at + 8 * wide * high
    gram, at = matrix(at, high, high), at + 8 * high * high
    factor, at = matrix(at, high, high), at + 8 * high * high
    turned_factor, at = matrix(at, high, high), at + 8 * high * high
    goal, own, ones, middle = at, at + line, at + 2 * line, at + 3 * line
    root, inverse_root, at = at + 4 * line, at + 5 * line, at + 6 * line
    fill(vector(space, (at - space) >> 3), 0.0)  # what is behind the rows
    fill(vector(own, wide), 1.0)
    fill(vector(ones, wide), 1.0)
    square, at = matrix(at, q, q), at + 8 * q * q
    reduced, at = matrix(at, p, n), at + 8 * p * n
    schur, at = matrix(at, p, p), at + 8 * p * p
    R, at = matrix(at, N, N), at + 8 * N * N
    J, at = matrix(at, N, N), at + 8 * N * N
    fill(vector(at, 21 * line >> 3), 0.0)  # what is behind the vectors
    W = Workspace(
        square, gram, factor, turned_factor, columns, scaled, reduced, schur, R, J, vector(at, padded(q)),
        vector(at + line, high), vector(at + 2 * line, high), vector(at + 3 * line, high), vector(at + 4 * line, high),
        vector(ones, wide), vector(at + 5 * line, wide), vector(at + 6 * line, wide), vector(at + 7 * line, wide),
        vector(at + 8 * line, N), vector(at + 9 * line, N), vector(at + 10 * line, N), vector(at + 11 * line, N),
        vector(at + 12 * line, N), vector(at + 13 * line, N), vector(at + 14 * line, N),
        whole_numbers(at + 15 * line, k), whole_numbers(at + 16 * line, N), whole_numbers(at + 17 * line, N),
    )  # fmt: skip
    at += 18 * line
    compliances, x, z = vector(at, k), vector(at + line, n), vector(at + 2 * line, k)
    for lane in range(lanes):
        first, last, A = 8 * n * lane, 8 * N * lane, data(given) + 8 * m * n * lane
        target = data(given + 8) + 8 * rest * lane
        damping = target + 16 * m
        C = damping + 16 * n
        lower = C + 8 * (p * n + p)
        P = Problem(
            rows, turned, vector(goal, m), vector(goal, high), compliances, vector(own, n), vector(middle, n),
            vector(lower, N), vector(lower + 8 * N, N), vector(root, n), vector(inverse_root, n),
        )  # fmt: skip
        labels = whole_numbers(active + last // 2, N)
        said, guessed = whole_numbers(report + 12 * lane, 3), whole_numbers(guess + last // 2, N)
        begin(
            P, matrix(A, m, n), vector(target, m), vector(target + 8 * m, m), vector(damping, n),
            vector(damping + 8 * n, n), matrix(C, p, n), vector(C + 8 * p * n, p),
        )  # fmt: skip
        first_labels(P, guessed, labels)
        for i in range(3):
            said[i] = 0
        fill(z, 0.0)
        search(P, W, labels, vector(tolerance, lanes)[lane], whole_numbers(most, 1)[0], x, z, said)
        if said[0] == 0:
            first_labels(P, guessed, labels)
        put_multiple(vector(solution + first, n), 1.0, x, n)
        y = vector(multipliers + 8 * p * lane, p)
        for j in range(p):
            y[j] = z[m + j] if labels[n + j] != INACTIVE else 0.0
    return 0
