"""Least time along a path under limits of speed and acceleration: reachability analysis in the squared path speed.

The squared path speed b is linear in s on each cell of a grid, so the path acceleration u is constant there. Rows of
limits hold at both ends of a cell. A backward pass finds the largest b from which the path can still be finished, a
forward pass takes the largest u that stays below it: the optimum of the discretised problem (H. Pham and Q.-C. Pham, "A
new approach to time-optimal path parameterization based on reachability analysis", T-RO 2018). The linear programs in
(u, b) have closed forms here, pair of rows by pair, so all cells are computed at once but for two short scans.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._cells import Cells, timed

_TINY = 1e-12


class _Rows(NamedTuple):
    """Limits ``|p u + r b| <= a`` of each cell; the sign of p has been moved to r, so p >= 0."""

    p: Float[Array, "K m"]
    r: Float[Array, "K m"]
    a: Float[Array, "K m"]


def least_time(
    grid: Float[Array, " K1"],
    first: Float[Array, "K1 n"],
    second: Float[Array, "K1 n"],
    cap: Float[Array, " K1"],
    acceleration: Float[Array, " n"],
) -> Cells:
    """Return the least-time progress from rest to rest.

    Args:
        grid: increasing path parameters.
        first, second: derivatives of the path at the grid.
        cap: largest squared path speed at the grid, by limits of speed.
        acceleration: limits of acceleration, infinite where there is none.
    """
    width = jnp.diff(grid)
    rows = _rows(width, first, second, acceleration)
    largest = jnp.minimum(cap[:-1], _feasible(width, rows)).at[0].set(0.0)
    square = _forward(width, rows, _backward(width, rows, largest))
    slope = jnp.diff(square) / width
    zero = jnp.zeros_like(width)
    path = jnp.stack([grid[:-1], zero + 1.0, zero, zero], axis=1)
    return timed(width, path, jnp.stack([square[:-1], slope, zero], axis=1), square[-1])


def _rows(width: Array, first: Array, second: Array, limit: Array) -> _Rows:
    """Return the rows of both ends of each cell, in units of their limits: at the far end b is ``b + 2 width u``."""
    scaled_first, scaled_second = first / limit, second / limit
    far = scaled_first[1:] + 2.0 * width[:, None] * scaled_second[1:]
    p = jnp.concatenate([scaled_first[:-1], far], axis=1)
    r = jnp.concatenate([scaled_second[:-1], scaled_second[1:]], axis=1)
    return _Rows(jnp.abs(p), jnp.where(p < 0.0, -r, r), jnp.ones_like(p))


def largest_square(coefficient: Array, constant: Array) -> Array:
    """Return the largest b with ``coefficient b <= constant``; infinite where the coefficient is not positive."""
    acts = coefficient > _TINY * constant
    return jnp.where(acts, constant / jnp.where(acts, coefficient, 1.0), jnp.inf)


def _feasible(width: Array, rows: _Rows) -> Float[Array, " K"]:
    """Return the largest b of each cell for which some u meets all rows and keeps b from becoming negative."""
    p, r, a = rows.p.T, rows.r.T, rows.a.T
    most = largest_square(2.0 * width * r - p, 2.0 * width * a).min(axis=0)
    for row in range(1, len(p)):  # slices instead of an array of all pairs: XLA fuses them
        beside = jnp.abs(p[row] * r[:row] - p[:row] * r[row]), p[row] * a[:row] + p[:row] * a[row]
        most = jnp.minimum(most, largest_square(*beside).min(axis=0))
    return most


def _backward(width: Array, rows: _Rows, largest: Float[Array, " K"]) -> Float[Array, " K1"]:
    """Return the largest b at each grid point from which rest at the end can be reached."""

    def step(ahead: Array, cell: tuple[Array, _Rows, Array]) -> tuple[Array, Array]:
        twice, (p, r, a), most = cell
        here = jnp.minimum(most, largest_square(p - twice * r, p * ahead + twice * a).min())
        return here, here

    inputs: Any = 2.0 * width, rows, largest
    end = jnp.zeros((), largest.dtype)
    return jnp.append(jax.lax.scan(step, end, inputs, reverse=True)[1], end)


def _forward(width: Array, rows: _Rows, reachable: Float[Array, " K1"]) -> Float[Array, " K1"]:
    """Return b at the grid points where each cell has the largest path acceleration that is allowed."""

    def step(b: Array, cell: tuple[Array, _Rows, Array]) -> tuple[Array, Array]:
        twice, (p, r, a), ahead = cell
        most = ((a - r * b) / jnp.maximum(p, _TINY)).min()
        b = jnp.clip(b + twice * most, 0.0, ahead)
        return b, b

    start = jnp.zeros((), reachable.dtype)
    inputs: Any = 2.0 * width, rows, reachable[1:]
    return jnp.concatenate([start[None], jax.lax.scan(step, start, inputs)[1]])
