"""Kernel of ``retargeting/_plan.py``: Levenberg and Marquardt's method for a clip, one clip after another.

In the words of that file, which says what everything is for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ._banded import solve_clip
from ._clip_frames import ask_clip, clipped
from ._clip_workspace import (
    BODIES,
    DOFS,
    FULL,
    POINTS,
    SMOOTH,
    SMOOTH_BASE,
    SPEED,
    STIFFNESS,
    WISHES,
    Goal,
    Linearised,
    kept,
    memory,
    numbers,
    structure,
)
from ._dense import fill
from ._frame import arguments, compiled, data, dimension, is_call, lean, matrix, results, vector
from ._manifold import difference, integrate
from ._tiles import padded

LARGEST_STEP, STIFFENING, SLOWING, FIXED, LEAST, STIFF, MOST, CALMER, CAREFUL, LITTLE, SETTLED = range(11)
STIFFNESS_AT_FIRST, DAMPING_AT_FIRST, MOST_ITERATIONS, UNTIL_READY, UNTIL_SETTLED = range(11, 16)
"""Numbers of the method, as in ``retargeting/_plan_kernel.py``."""


class Steps(NamedTuple):
    """Memory for what a clip's steps cost, and for the solution of its systems."""

    before: np.ndarray  # (n,)
    step: np.ndarray  # (n,)
    damping: np.ndarray  # (F,)
    right: np.ndarray  # (F, n)
    move: np.ndarray  # (F, n)
    upper: np.ndarray  # (F N, N)
    near: np.ndarray  # (F N, N)
    work: np.ndarray  # (N + 2 POINTS + 2, N)


@lean
def limit_step(V, there, t, step, out):
    """Return what a step beyond the limits of speed costs: the cost of frame t and the next."""
    limit, stiffness, cost = V.wishes[SPEED], V.wishes[STIFFNESS], 0.0
    for j in range(len(step)):
        value, bound = there * step[j], V.step[j]
        over = value - clipped(value, -bound, bound)
        if over != 0.0:
            beyond = limit / bound**2
            weight, pull = stiffness * beyond, stiffness * beyond * over
            cost += 0.5 * beyond * over * over
            out.alone[t, j] += weight
            out.alone[t + 1, j] += weight
            out.first[t + 1, j] -= weight
            out.gradient[t, j] -= pull
            out.gradient[t + 1, j] += pull
    return cost


@lean
def limit_change(K, V, there, t, before, step, out):
    """Return what a change of steps costs, and one beyond the limits of acceleration, in frames t to t + 2."""
    limit, stiffness, soft, penalty = V.wishes[SPEED], V.wishes[STIFFNESS], 0.0, 0.0
    for j in range(len(step)):
        value, bound = there * (step[j] - before[j]), V.change[j]
        smooth = there * (V.wishes[SMOOTH] if K.joints[j] >= 0 else V.wishes[SMOOTH_BASE])
        over = value - clipped(value, -bound, bound)
        beyond = limit / bound**2 if over != 0.0 else 0.0
        c, a = smooth + stiffness * beyond, smooth * value + stiffness * beyond * over
        soft += 0.5 * smooth * value * value
        penalty += 0.5 * beyond * over * over
        out.alone[t, j] += c
        out.alone[t + 1, j] += 4.0 * c
        out.alone[t + 2, j] += c
        out.first[t + 1, j] -= 2.0 * c
        out.first[t + 2, j] -= 2.0 * c
        out.second[t + 2, j] += c
        out.gradient[t, j] += a
        out.gradient[t + 1, j] -= 2.0 * a
        out.gradient[t + 2, j] += a
    return soft, penalty


@lean
def linearise(K, V, W, G, R, T, q, out):
    """Make Gauss-Newton's system at some configurations; what wishes and bounds cost there."""
    soft, penalty = ask_clip(K, V, W, G, R, q, out)
    frames = len(q)
    for t in range(frames):
        fill(out.first[t], 0.0)
        fill(out.second[t], 0.0)
    for t in range(frames - 1):
        if G.present[t + 1] == 0.0:
            fill(T.before, 0.0)
            continue
        difference(K.scalars, K.turns, q[t], q[t + 1], T.step)
        penalty += limit_step(V, G.present[t + 1], t, T.step, out)
        if t > 0:
            wishes, bounds = limit_change(K, V, G.present[t + 1], t - 1, T.before, T.step, out)
            soft, penalty = soft + wishes, penalty + bounds
        for j in range(len(T.step)):
            T.before[j] = T.step[j]
    return soft, penalty


@lean
def step_from(K, C, T, here, free, damping, q, candidate):
    """Solve the damped system and take the step, no longer than the linear model is good for."""
    frames, n = T.right.shape
    N = padded(n + 1)
    for t in range(frames):
        T.damping[t] = damping if free[t] == 1.0 else C[FIXED]
        for j in range(n):
            T.right[t, j] = free[t] * here.gradient[t, j]
    solve_clip(n, N, here, T.damping, T.right, T.move, T.upper, T.near, T.work)
    for t in range(frames):
        longest = C[LARGEST_STEP]
        for j in range(n):
            T.move[t, j] *= -free[t]
            longest = max(longest, abs(T.move[t, j]))
        for j in range(n):
            T.move[t, j] *= C[LARGEST_STEP] / longest
        integrate(K.scalars, K.turns, q[t], T.move[t], candidate[t])


@lean
def descend(K, V, W, G, R, T, C, free, q, other, here, there, cost):
    """Improve q; ``other`` and ``there`` are memory. Return how many systems it took, and where the answer is.

    Args:
        K: structure.
        V: numbers, the stiffness among them.
        W: memory for a frame.
        G: goals.
        R: memory for rows.
        T: memory for steps.
        C: numbers of the method.
        free: 1 for frames that may move. (F,)
        q: where it begins. (F, nq)
        other: memory. (F, nq)
        here: memory for a system.
        there: memory for another.
        cost: what is left of wishes and bounds. (2,)
    """
    stiffness, damping, growth = C[STIFFNESS_AT_FIRST], C[DAMPING_AT_FIRST], C[CAREFUL]
    ready, settled, iterations = False, 0.0, 0
    V.wishes[STIFFNESS] = stiffness
    soft, penalty = linearise(K, V, W, G, R, T, q, here)
    swapped = False
    while iterations < C[MOST_ITERATIONS]:
        if (C[UNTIL_SETTLED] != 0.0 and settled >= C[SETTLED]) or (C[UNTIL_READY] != 0.0 and ready):
            break
        stiffer = min(stiffness * C[STIFFENING], 1.0) if ready else stiffness
        V.wishes[STIFFNESS] = stiffer
        if swapped:
            step_from(K, C, T, there, free, damping, other, q)
            soft_there, penalty_there = linearise(K, V, W, G, R, T, q, here)
        else:
            step_from(K, C, T, here, free, damping, q, other)
            soft_there, penalty_there = linearise(K, V, W, G, R, T, other, there)
        before, after = soft + stiffness * penalty, soft_there + stiffness * penalty_there
        better = after < before
        small = C[LITTLE] * soft
        little = stiffness >= 1.0 and before - after < small
        if little:
            settled += (1.0 if better else 0.0) + (1.0 if penalty < small else 0.0)
        elif better:
            settled = 0.0
        if not better and damping >= C[MOST]:
            settled = C[SETTLED]
        least = C[STIFF] if not better or stiffer >= 1.0 else C[LEAST]
        damping = min(max(damping * (C[CALMER] if better else growth), least), C[MOST])
        growth = C[CAREFUL] if better else 2.0 * growth
        if better:
            ready = before - after < C[SLOWING] * before
            soft, penalty, stiffness, swapped = soft_there, penalty_there, stiffer, not swapped
        iterations += 1
    cost[0], cost[1] = soft, penalty
    return iterations, swapped


@compiled
def system(at, frames, n):
    """Return memory for a system at an address, and where more is."""
    N = padded(n + 1)
    blocks, at = matrix(at, frames * N, N), at + 8 * frames * N * N
    moving, at = matrix(at, frames * POINTS, N), at + 8 * frames * POINTS * N
    weight, at = matrix(at, frames, POINTS), at + 8 * frames * POINTS
    gradient, at = matrix(at, frames, n), at + 8 * frames * n
    alone, at = matrix(at, frames, n), at + 8 * frames * n
    first, at = matrix(at, frames, n), at + 8 * frames * n
    second, at = matrix(at, frames, n), at + 8 * frames * n
    return Linearised(blocks, moving, weight, gradient, alone, first, second), at


@compiled
def steps(at, frames, n):
    """Return memory for steps at an address, and where more is."""
    N = padded(n + 1)
    before, at = vector(at, n), at + 8 * n
    step, at = vector(at, n), at + 8 * n
    damping, at = vector(at, frames), at + 8 * frames
    right, at = matrix(at, frames, n), at + 8 * frames * n
    move, at = matrix(at, frames, n), at + 8 * frames * n
    upper, at = matrix(at, frames * N, N), at + 8 * frames * N * N
    near, at = matrix(at, frames * N, N), at + 8 * frames * N * N
    work = matrix(at, N + 2 * POINTS + 2, N)
    return Steps(before, step, damping, right, move, upper, near, work), at + 8 * N * (N + 2 * POINTS + 2)


@lean
def lane_of(pointer, lane):
    """Address of a lane's numbers in the buffer at a pointer, or of those that all lanes share."""
    if dimension(pointer, 0) == 1:
        return data(pointer)
    return data(pointer) + 8 * lane * dimension(pointer, 8)


@lean
def copy(a, b):
    """Copy b to a."""
    for i in range(len(a)):
        for j in range(a.shape[1]):
            a[i, j] = b[i, j]


def handle(frame):
    """Answer a call of XLA: arguments as in ``retargeting/_plan_kernel.py``, flat, with an axis of lanes or of 1."""
    if not is_call(frame):
        return 0
    given, found = arguments(frame), results(frame)  # pointers to buffers, eight bytes each
    lanes, frames, nq = dimension(found, 0), dimension(found, 8), dimension(found, 16)
    K = structure(data(given + 88))
    n, full = K.counts[DOFS], K.counts[FULL]
    W, at = memory(K.counts, data(found + 24))
    R, at = kept(K.counts, at)
    at = (at + 63) // 64 * 64
    here, at = system(at, frames, n)
    there, at = system(at, frames, n)
    T, at = steps(at, frames, n)
    other, wishes = matrix(at, frames, nq), vector(at + 8 * frames * nq, WISHES)
    for body in range(K.counts[BODIES]):
        for dof in range(padded(full)):
            W.masks[body, dof] = 1.0 if dof < full and K.moves[body * full + dof] != 0 else 0.0
    fill(W.line, 0.0)
    for lane in range(lanes):
        q = matrix(data(found) + 8 * frames * nq * lane, frames, nq)
        copy(q, matrix(lane_of(given, lane), frames, nq))
        G = Goal(
            matrix(lane_of(given + 8, lane), frames, 24), matrix(lane_of(given + 16, lane), frames, 9),
            matrix(lane_of(given + 24, lane), frames, 9), matrix(lane_of(given + 32, lane), frames, 3),
            matrix(lane_of(given + 40, lane), frames, 18), matrix(lane_of(given + 48, lane), frames, 4),
            vector(lane_of(given + 56, lane), frames),
        )  # fmt: skip
        free, C = vector(lane_of(given + 64, lane), frames), vector(lane_of(given + 80, lane), 16)
        V, cost = numbers(K.counts, lane_of(given + 72, lane), wishes), vector(data(found + 8) + 16 * lane, 2)
        count, swapped = descend(K, V, W, G, R, T, C, free, q, other, here, there, cost)
        vector(data(found + 16) + 8 * lane, 1)[0] = count
        if swapped:
            copy(q, other)
    return 0
