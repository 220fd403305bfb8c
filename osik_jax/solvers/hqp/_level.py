"""One level of a hierarchy: a primal active set on the minimisers of the levels above.

    min 1/2 |dist(A x, [l, u])|^2   over   {x: frozen rows keep their values},  hard rows stay in their intervals

The start is feasible and stays so. Each iteration projects the level's rows on the null space of what is frozen or
active, takes the least-squares step there (rank-revealing QR), and walks to the first hard row that blocks it, with an
exact line search where a row of the level enters or leaves its interval. Where the step vanishes, the most wrongly
signed multiplier is dropped; none left means optimal. After a run of steps of zero length the choices follow the least
index (R. G. Bland, "New finite pivoting rules for the simplex method", 1977), which cannot cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product


class Tolerances(NamedTuple):
    """What counts as zero, relative to the scale of the quantity at hand."""

    rank: Float[Array, ""] | float  # part of a row outside the span of others, relative to the row
    step: Float[Array, ""] | float  # change of the level's rows by a step, relative to their scale
    multiplier: Float[Array, ""] | float  # multiplier, relative to the level's gradient


class Hard(NamedTuple):
    """Rows that a level must not touch: the box, then the rows of the levels above."""

    matrix: Float[Array, "h n"]
    lower: Float[Array, " h"]
    upper: Float[Array, " h"]
    free: Bool[Array, " h"]  # neither frozen as an equality nor without bounds


class LevelState(NamedTuple):
    """Iterate of one level."""

    x: Float[Array, " n"]
    side: Int[Array, " h"]  # of each hard row: -1 held at its lower bound, 1 at its upper, 0 not held
    multiplier: Float[Array, " h"]
    residual: Float[Array, ""]  # stationarity
    stalled: Int[Array, ""]  # steps of zero length in a row
    iterations: Int[Array, ""]
    done: Bool[Array, ""]


class _Held(NamedTuple):
    """Orthonormal factors of the rows that are held."""

    rows: Int[Array, " n"]  # indices of the held rows, first
    valid: Bool[Array, " n"]
    basis: Float[Array, "n n"]  # orthonormal columns spanning them, 0 where not valid
    triangle: Float[Array, "n n"]
    projector: Float[Array, "n n"]  # on the null space of frozen and held rows


def solve_level(
    matrix: Float[Array, "m n"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    hard: Hard,
    projector: Float[Array, "n n"],
    start: LevelState,
    tolerances: Tolerances,
    max_iterations: int,
) -> LevelState:
    """Minimises the distance of the level's rows to their intervals, from a feasible start.

    Args:
        matrix: the level's rows, weights multiplied in.
        lower: of the rows.
        upper: of the rows.
        hard: rows that must stay in their intervals.
        projector: onto the null space of the frozen rows.
        start: feasible x, and hard rows held at the start (independent of each other and of the frozen ones).
        tolerances: what counts as zero.
        max_iterations: cap (static).
    """
    length = jnp.sqrt(jnp.sum(matrix**2, -1))
    scale = jnp.max(length, initial=0.0)

    def body(s: LevelState) -> LevelState:
        value = apply(matrix, s.x)
        slack = value - jnp.clip(value, lower, upper)
        counts = (slack != 0.0) | (lower == upper)
        held = _factor_held(hard, s.side, projector)
        step = _least_squares_step(matrix, slack, counts, held.projector, tolerances.rank * scale)
        change = jnp.where(counts, apply(matrix, step), 0.0)
        noise = rounding(scale, s.x, slack, tolerances)
        still = jnp.sqrt(jnp.sum(change**2)) <= noise
        # one LAPACK call after another: see osik_jax/_runtime.py
        held, step = jax.lax.optimization_barrier((held, step))
        at_rest = _drop(hard, s, apply(matrix.T, slack), noise * scale, held, projector, tolerances)
        moved = _advance(matrix, lower, upper, hard, s, step, tolerances)
        out = jax.tree.map(lambda a, b: jnp.where(still, a, b), at_rest, moved)
        return out._replace(iterations=s.iterations + 1)

    def go_on(s: LevelState) -> Bool[Array, ""]:
        return ~s.done & (s.iterations < max_iterations)

    return jax.lax.while_loop(go_on, body, start)


def rounding(
    scale: Float[Array, ""], x: Float[Array, " n"], slack: Float[Array, " m"], tolerances: Tolerances
) -> Float[Array, ""]:
    """Changes of the level's rows under this are noise."""
    return tolerances.step * (scale * jnp.max(jnp.abs(x)) + jnp.sqrt(jnp.sum(slack**2)))


def independent(
    hard: Hard, side: Int[Array, " h"], projector: Float[Array, "n n"], rank: Array | float
) -> Int[Array, " h"]:
    """``side`` without the rows that depend on frozen rows or on held rows before them."""
    held = _factor_held(hard, side, projector)
    length = jnp.sqrt(jnp.sum(hard.matrix[held.rows] ** 2, -1))
    keep = held.valid & (jnp.abs(jnp.diagonal(held.triangle)) > rank * length)
    return jnp.zeros_like(side).at[held.rows].set(jnp.where(keep, side[held.rows], 0))


def row_space(rows: Float[Array, "m n"], projector: Float[Array, "n n"], rank: Array | float) -> Float[Array, "n k"]:
    """Orthonormal basis (0 columns beyond the rank) of what the rows span inside the projector's range."""
    length = jnp.sqrt(jnp.sum(rows**2, -1, keepdims=True))
    unit = rows / jnp.where(length > 0.0, length, 1.0)
    basis, triangle, _ = jax.scipy.linalg.qr(product(unit, projector).T, mode="economic", pivoting=True)
    return jnp.where(jnp.abs(jnp.diagonal(triangle)) > rank, basis, 0.0)


def _factor_held(hard: Hard, side: Int[Array, " h"], projector: Float[Array, "n n"]) -> _Held:
    n = projector.shape[0]
    held = side != 0
    rows = jnp.argsort(~held, stable=True)[:n]
    valid = held[rows]
    normals = jnp.where(valid[:, None], product(hard.matrix[rows], projector), 0.0)
    basis, triangle = jnp.linalg.qr(normals.T)
    basis = jnp.where(valid, basis, 0.0)
    return _Held(rows, valid, basis, triangle, projector - product(basis, basis.T))


def _least_squares_step(
    matrix: Float[Array, "m n"],
    slack: Float[Array, " m"],
    counts: Bool[Array, " m"],
    projector: Float[Array, "n n"],
    threshold: Float[Array, ""],
) -> Float[Array, " n"]:
    """Minimises |A d + slack| over d in the projector's range and the rows that count; small pivots are cut off."""
    n = projector.shape[0]
    if not matrix.shape[0]:
        return jnp.zeros(n, projector.dtype)
    rows = jnp.where(counts[:, None], product(matrix, projector), 0.0)
    basis, triangle, order = jax.scipy.linalg.qr(rows, mode="economic", pivoting=True)
    k = min(rows.shape)
    keep = jnp.abs(jnp.diagonal(triangle)) > threshold
    square = jnp.where(keep[:, None] & keep[None, :], triangle[:, :k], jnp.eye(k, dtype=rows.dtype))
    right = jnp.where(keep, -apply(basis.T, jnp.where(counts, slack, 0.0)), 0.0)
    step = jnp.zeros(n, rows.dtype).at[order[:k]].set(jax.scipy.linalg.solve_triangular(square, right))
    return apply(projector, step)


def _drop(
    hard: Hard,
    s: LevelState,
    gradient: Float[Array, " n"],
    noise: Float[Array, ""],
    held: _Held,
    projector: Float[Array, "n n"],
    tolerances: Tolerances,
) -> LevelState:
    """At rest on the held rows: releases the one with the most wrongly signed multiplier, or declares the optimum."""
    downhill = -apply(projector, gradient)
    triangle = jnp.where(held.valid[:, None] & held.valid[None, :], held.triangle, jnp.eye(len(held.rows)))
    solved = jax.scipy.linalg.solve_triangular(triangle, jnp.where(held.valid, apply(held.basis.T, downhill), 0.0))
    multiplier = jnp.zeros_like(s.multiplier).at[held.rows].set(jnp.where(held.valid, solved, 0.0))
    length = jnp.sqrt(jnp.sum(hard.matrix**2, -1))
    pressure = multiplier * s.side * length
    wrong = (s.side != 0) & (pressure < -tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) - noise)
    worst = jnp.where(s.stalled > _PATIENCE, jnp.argmax(wrong), jnp.argmin(jnp.where(wrong, pressure, jnp.inf)))
    release = wrong.any()
    return s._replace(
        side=s.side.at[worst].set(jnp.where(release, 0, s.side[worst])),
        multiplier=multiplier,
        residual=jnp.max(jnp.abs(apply(held.projector, gradient))),
        done=~release,
    )


def _advance(
    matrix: Array, lower: Array, upper: Array, hard: Hard, s: LevelState, step: Array, tolerances: Tolerances
) -> LevelState:
    """Walks along the step as far as the hard rows and the exact line search allow."""
    value, rate = apply(hard.matrix, s.x), apply(hard.matrix, step)
    size = jnp.sqrt(jnp.sum(step**2)) * jnp.sqrt(jnp.sum(hard.matrix**2, -1))
    towards = hard.free & (s.side == 0) & (jnp.abs(rate) > tolerances.rank * size)
    bound = jnp.where(rate > 0.0, hard.upper, hard.lower)
    safe = jnp.where(towards, rate, 1.0)
    times = jnp.where(towards, jnp.maximum(jnp.where(towards, bound - value, jnp.inf) / safe, 0.0), jnp.inf)
    limit = jnp.min(times, initial=jnp.inf)
    ideal = _line_search(apply(matrix, s.x), apply(matrix, step), lower, upper)
    blocked = limit <= ideal
    length = jnp.minimum(limit, ideal)
    first = jnp.argmin(times)  # the least index among ties
    x = s.x + length * step
    stalled = jnp.where(length * jnp.max(jnp.abs(step)) > 0.0, 0, s.stalled + 1)
    side = s.side.at[first].set(jnp.where(blocked, jnp.where(rate[first] > 0.0, 1, -1), s.side[first]))
    return s._replace(x=x, side=side, stalled=stalled)


def _line_search(value: Array, rate: Array, lower: Array, upper: Array) -> Float[Array, ""]:
    """Exact minimiser t >= 0 of |dist(value + t rate, [lower, upper])|^2, a convex piecewise quadratic."""
    moving = rate != 0.0
    safe = jnp.where(moving, rate, 1.0)
    ends = [
        jnp.where(moving & jnp.isfinite(b), (jnp.where(jnp.isfinite(b), b, 0.0) - value) / safe, 1.0)
        for b in (lower, upper)
    ]
    knots = jnp.maximum(jnp.concatenate([*ends, jnp.ones(1, value.dtype), jnp.zeros(1, value.dtype)]), 0.0)

    def slope(t: Array) -> Array:
        at = value + t * rate
        return jnp.sum(rate * (at - jnp.clip(at, lower, upper)))

    slopes = jax.vmap(slope)(knots)
    before = jnp.max(jnp.where(slopes < 0.0, knots, 0.0), initial=0.0)
    middle = jnp.min(jnp.where(knots > before, knots, jnp.inf))  # the next knot, where the slope is >= 0
    probe = jnp.where(jnp.isinf(middle), before + 1.0, 0.5 * (before + middle))
    low, high = slope(before), slope(probe)  # linear between knots: extrapolate the secant
    rising = high > low
    best = before - low * (probe - before) / jnp.where(rising, high - low, 1.0)
    return jnp.where(rising, jnp.maximum(best, 0.0), before)


_PATIENCE = 20
