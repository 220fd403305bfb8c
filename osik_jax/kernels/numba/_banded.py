"""For the kernel of ``retargeting/_plan.py``: a clip's banded system, from first frame to last and back.

With U' = L the blocks of the factor are kept as their transposes, so that all products are of the kind A'B: U_t on the
diagonal, N_t = L[t-1]^-1 B' one frame back, and G_t = L[t-2]^-1 diag(s) two back, lower triangular. The right-hand side
is a column of the matrix behind its last: what factors the matrix solves for y on the way.
"""

from __future__ import annotations

import numpy as np

from ._dense import any_number, fill
from ._frame import lean
from ._tiles import (
    WIDTH,
    factor,
    padded,
    solve_lower,
    solve_lower_diagonal,
    take_product,
    take_product_of_lower,
    take_square,
    take_square_of_lower,
)
from ._vectors import add, dot


@lean
def is_coupled(weight, first, second, t):
    """Whether a frame has a block one frame back; those behind a clip's end have none."""
    return any_number(weight[t]) or any_number(first[t]) or any_number(second[t])


@lean
def start_frame(S, block, alone, damping, right, n):
    """Put the frame's own block, and its right-hand side behind it."""
    for i in range(n):
        for j in range(i // WIDTH * WIDTH, n):
            S[i, j] = -block[i, j]
        S[i, i] += alone[i] + damping
        S[i, n] = right[i]


@lean
def couple(X, rows, before, weight, first, scaled, plain, n):
    """X becomes ``diag(first) - before' diag(weight) rows``: the block one frame back."""
    for i in range(n):
        fill(X[i], 0.0)
        X[i, i] = first[i]
    count = 0
    for k in range(len(weight)):
        if weight[k] != 0.0:
            for j in range(n):
                scaled[count, j] = weight[k] * rows[k, j]
                plain[count, j] = before[k, j]
            count += 1
    take_product(X, plain, scaled, 0, n, 0, padded(n), 0, count)


@lean
def take_solved(S, G, y, v, n):
    """Take ``G'y`` off the right-hand side of S."""
    fill(v, 0.0)
    for k in range(n):
        add(v, y[k, n], G[k], 0, n)
    for i in range(n):
        S[i, n] -= v[i]


@lean
def back(U, x, n):
    """x becomes ``U^-1 x``."""
    for i in range(n - 1, -1, -1):
        x[i] = (x[i] - dot(U[i], x, i + 1, n)) * U[i, i]


@lean
def forth(U, x, n):
    """x becomes ``U'^-1 x``."""
    for i in range(n):
        x[i] *= U[i, i]
        add(x, -x[i], U[i], i + 1, n)


@lean
def solve_clip(n, N, system, damping, right, x, upper, near, work):
    """x of one system with more on its diagonal; not finite where it is not positive definite.

    Args:
        n: dofs.
        N: length of the rows that are worked with.
        system: ``_clip_workspace.py: Linearised``.
        damping: what each frame's diagonal has more. (F,)
        right: (F, n)
        x: the solution. (F, n)
        upper: memory for U of all frames. (F N, N)
        near: memory for N of all frames. (F N, N)
        work: more memory. (N + 2 m + 2, N)
    """
    rows, weight, first, second = system.moving, system.weight, system.first, system.second
    frames, m = weight.shape
    while frames > 1 and not (is_coupled(weight, first, second, frames - 1) or any_number(right[frames - 1])):
        frames -= 1  # behind a clip's end
        fill(x[frames], 0.0)
    G, scaled, plain = work[:N], work[N : N + m], work[N + m : N + 2 * m]
    v, z = work[N + 2 * m], work[N + 2 * m + 1]
    for t in range(frames):
        S = upper[t * N : (t + 1) * N]
        start_frame(S, system.blocks[t * N : (t + 1) * N], system.alone[t], damping[t], right[t], n)
        near_too, far = is_coupled(weight, first, second, t), any_number(second[t])
        if far:
            solve_lower_diagonal(upper[(t - 2) * N : (t - 1) * N], G, second[t], n)
        if near_too:
            X, above = near[t * N : (t + 1) * N], upper[(t - 1) * N : t * N]
            couple(X, rows[t * m : (t + 1) * m], rows[(t - 1) * m : t * m], weight[t], first[t], scaled, plain, n)
            if far:
                take_product_of_lower(X, near[(t - 1) * N : t * N], G, n)
            solve_lower(above, X, n, 0, padded(n))
            for k in range(n):
                X[k, n] = above[k, n]
            take_square(S, X, n, N, 0, n)
        if far:
            take_square_of_lower(S, G, n)
            take_solved(S, G, upper[(t - 2) * N : (t - 1) * N], v, n)
        if not factor(S, n, N):
            for k in range(frames):
                fill(x[k], np.nan)
            return
    for t in range(frames - 1, -1, -1):
        U, out = upper[t * N : (t + 1) * N], x[t]
        for i in range(n):
            v[i] = U[i, n]
        if t + 1 < frames and is_coupled(weight, first, second, t + 1):
            X = near[(t + 1) * N : (t + 2) * N]
            for i in range(n):
                v[i] -= dot(X[i], x[t + 1], 0, n)
        if t + 2 < frames and any_number(second[t + 2]):
            for i in range(n):
                z[i] = second[t + 2, i] * x[t + 2, i]
            forth(U, z, n)
            for i in range(n):
                v[i] -= z[i]
        back(U, v, n)
        for i in range(n):
            out[i] = v[i]
