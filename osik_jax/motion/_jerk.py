"""Least time under limits of jerk: a barrier method in the squared rate of a smooth reference motion.

The least-time motion without limits of jerk, smoothed, is a reference s(z) that starts and ends at rest. Its time z is
stretched or shrunk: ``b = (dz/dt)^2`` is a quadratic spline on a uniform grid. Limits of speed and acceleration are
linear in b and its derivatives. A limit of jerk, divided by ``sqrt(b)``, is ``|linear| <= j / sqrt(b)``. Its right side
is convex, so the tangent is a bound from the inside, and each step minimises a convex problem with feasible answers
(F. Debrouwere et al., "Time-optimal path following for robots with convex-concave constraints using sequential convex
programming", T-RO 2013), here by one Newton step of a barrier method. The reference makes the rate smooth and positive
at the ends, where the path speed is 0 and derivatives by s are infinite.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._cells import Cells, timed

_STEPS, _LAST_STEPS = 47, 3
_SHRINK = 0.75  # of the barrier's weight in a step
_LEAST_GAP = {"float32": 1e-3, "float64": 1e-5}
"""Least weight of the barrier, as a share of the duration: the rounding of margins bounds it from below."""
_MOST = 4.0
"""Largest squared rate, a bound on b where the reference stands still: it is hardly slower than the optimum."""
PLACES = np.array([0.0, 1.0, 2.0, 3.0]) / 3.0
"""Places in each cell at which limits are kept, as shares of its width."""
_PIECES = np.array([[0.5, 0.5, 0.0], [-1.0, 1.0, 0.0], [0.5, -1.0, 0.5]])
"""Coefficients of a cell's polynomial, rising powers, by those of a uniform quadratic B-spline."""
CUBIC = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6.0
"""The same of a uniform cubic B-spline."""
_STENCILS = np.array([[[1.0, x, x**2], [0.0, 1.0, 2.0 * x], [0.0, 0.0, 2.0]] for x in PLACES]) @ _PIECES
"""Value, slope and second derivative of the quadratic B-spline at the places, by its coefficients."""
_SHARES = np.array([1.0, 3.0, 3.0, 1.0]) / 8.0
"""Weights of the places in an integral over a cell."""


class Rows(NamedTuple):
    """Limits at four places of each of K cells, linear in b, its slope and its second derivative.

    Attributes:
        fixed: rows ``fixed . (b, b', b'') <= 1``: speeds and both signs of accelerations. (P, m, 3)
        jerk: rows ``sqrt(b) |jerk . (b, b', b'')| <= 1``. (P, n, 3)
    """

    fixed: Float[Array, "P m 3"]
    jerk: Float[Array, "P n 3"]


def reference(cells: Cells, ramp: Array, count: int) -> tuple[Float[Array, ""], Float[Array, "K 4"]]:
    """Return the width and the cubics of a smooth motion s(z) from rest to rest, on ``count`` cells of equal width.

    Args:
        cells: the least-time motion without limits of jerk.
        ramp: time that the smoothing spreads a jump of acceleration over [s].
        count: number of cells.
    """
    duration = cells.start[-1]
    spread = jnp.maximum(ramp, 4.0 * duration / count)
    width = (duration + spread) / (count - 4)
    along = cells.at(width * (jnp.arange(count + 3, dtype=width.dtype) - 3.0) - 0.5 * spread)[0]
    smooth = _moving_mean(along, spread / width)
    four = jnp.stack([smooth[i : i + count] for i in range(4)], axis=1)
    return width, (four @ CUBIC.T.astype(width.dtype)) / width ** jnp.arange(4)


def _moving_mean(values: Float[Array, " K"], window: Array) -> Float[Array, " K"]:
    """Return the mean over a window around each value; the window's length in values need not be whole."""
    count = len(values)
    sums = jnp.append(jnp.zeros((), values.dtype), jnp.cumsum(jnp.pad(values, count, mode="edge")))
    middle = count + 0.5 + jnp.arange(count, dtype=values.dtype)
    ends = jnp.stack([middle - 0.5 * window, middle + 0.5 * window])
    low, high = jnp.interp(ends, jnp.arange(len(sums), dtype=values.dtype), sums)
    return (high - low) / window


def rows_of(
    path: Float[Array, "4 P n"],
    thirds: Float[Array, "2 P n"],
    progress: Float[Array, "4 P"],
    cap: Float[Array, " P"],
    limits: Float[Array, "3 n"],
) -> Rows:
    """Return the rows of limits for a reference motion.

    Args:
        path: the path and its three derivatives by s.
        thirds: the third derivatives at both ends of the cell, which differ if a knot is inside.
        progress: s and its three derivatives by z.
        cap: largest squared path speed, by limits that are not of joints.
        limits: of speed, acceleration and jerk.
    """
    (_, q1, q2, _), (_, s1, s2, s3) = path, progress[..., None]
    first, second = q1 * s1, q2 * s1**2 + q1 * s2
    zero, alone = jnp.zeros_like(q1), 3.0 * q2 * s1 * s2 + q1 * s3
    speed = jnp.stack([(first / limits[0]) ** 2, zero, zero], axis=-1)
    speed = jnp.concatenate(
        [speed, (s1 / jnp.sqrt(cap)[:, None])[..., None] ** 2 * jnp.eye(3, dtype=cap.dtype)[:1]], axis=1
    )
    pull = jnp.stack([second, 0.5 * first, zero], axis=-1) / limits[1][:, None]
    jerk = [jnp.stack([q3 * s1**3 + alone, 1.5 * second, 0.5 * first], axis=-1) for q3 in thirds]
    jerk = jnp.concatenate(jerk, axis=1) / jnp.tile(limits[2], 2)[:, None]
    return Rows(jnp.concatenate([speed, pull, -pull], axis=1), jerk)


def stretched(width: Array, cubics: Float[Array, "K 4"], rows: Rows) -> Cells:
    """Return the least-time progress; its derivatives are those of the optimum, of first order."""
    square = _optimum(width, rows)
    pieces = jnp.stack([square[i : i + len(cubics)] for i in range(3)], axis=1) @ _PIECES.T.astype(width.dtype)
    return timed(
        jnp.broadcast_to(width, len(cubics)), cubics, pieces / width ** jnp.arange(3), 0.5 * (square[-2] + square[-1])
    )


def _values(square: Float[Array, " K2"], width: Array) -> Float[Array, "P 3"]:
    """Return b and its two derivatives at the places, by the spline's coefficients."""
    three = jnp.stack([square[i : len(square) - 2 + i] for i in range(3)], axis=1)
    return jnp.einsum("ecs,ks->kec", _stencils(width), three).reshape(-1, 3)


def _stencils(width: Array) -> Float[Array, "4 3 3"]:
    return jnp.asarray(_STENCILS, width.dtype) / width ** jnp.arange(3)[:, None]


def _margins(rows: Rows, values: Float[Array, "P 3"]) -> tuple[Array, Array, Array]:
    """Return by how much of each limit the motion stays below it."""
    jerk = jnp.sqrt(values[:, :1]) * jnp.einsum("knc,kc->kn", rows.jerk, values)
    return 1.0 - jnp.einsum("kmc,kc->km", rows.fixed, values), 1.0 - jerk, 1.0 + jerk


def _optimum(width: Array, rows: Rows) -> Float[Array, " K2"]:
    """Return the coefficients of b, with the derivatives of the barrier problem's stationary point.

    Where the gradient vanishes, a Newton step with the exact second derivatives moves by nothing, and its derivative by
    the arguments is that of the stationary point (the implicit function theorem).
    """
    least = _LEAST_GAP[str(width.dtype)]
    scale = width / len(PLACES) / (rows.fixed.shape[1] + 2 * rows.jerk.shape[1])
    fixed_width, fixed_scale, fixed_rows = jax.lax.stop_gradient((width, scale, rows))

    def step(square: Array, power: Array) -> tuple[Array, None]:
        weight = fixed_scale * jnp.maximum(_SHRINK**power, least)
        return _moved(square, fixed_width, fixed_rows, weight), None

    steps = jnp.arange(_STEPS, dtype=width.dtype)
    square = jax.lax.scan(step, _slow(fixed_width, fixed_rows), steps)[0]
    for _ in range(_LAST_STEPS):
        square = _moved(square, fixed_width, fixed_rows, fixed_scale * least, exact=True)
    move = _newton(jax.lax.stop_gradient(square), width, rows, scale * least, exact=True)[0]
    move = jnp.where(jnp.isfinite(move).all(), move, 0.0)
    return jax.lax.stop_gradient(square) + move - jax.lax.stop_gradient(move)


def _slow(width: Array, rows: Rows) -> Float[Array, " K2"]:
    """Return a constant b at which all limits hold, by a fifth."""
    ones = jnp.zeros((len(rows.fixed), 3), width.dtype).at[:, 0].set(1.0)
    fixed, jerk, _ = _margins(rows, ones)
    square = 0.8 / jnp.maximum(jnp.maximum(jnp.max(1.0 - fixed), 1.0), jnp.max(jnp.abs(1.0 - jerk)) ** (2.0 / 3.0))
    return jnp.full(len(rows.fixed) // len(PLACES) + 2, square)


def _moved(square: Float[Array, " K2"], width: Array, rows: Rows, weight: Array, exact: bool = False) -> Array:
    """Return the coefficients after one Newton step of the barrier problem, inside all limits.

    They stay where the step is not finite: the exact matrix may lose its sign to rounding in single precision.
    """
    move, taken = _newton(square, width, rows, weight, exact)
    known = jnp.isfinite(move).all() & jnp.isfinite(taken)
    return jnp.where(known, square + move * jnp.minimum(1.0, 0.9 / jnp.maximum(taken, 1e-9)), square)


def _newton(
    square: Float[Array, " K2"], width: Array, rows: Rows, weight: Array, exact: bool = False
) -> tuple[Float[Array, " K2"], Float[Array, ""]]:
    """Return a Newton step of the barrier problem, and the largest share of a margin that it takes.

    Without ``exact``, the convex bound of the limits of jerk is taken, so the step goes downhill. The step has the
    derivatives of the gradient alone: where that vanishes, those of the matrix do not count.
    """
    values, stencils = _values(square, width), _stencils(width)
    b, share = values[:, 0], jnp.tile(width * jnp.asarray(_SHARES, width.dtype), len(square) - 2)
    margin, slope = _linear_margins(rows, values)
    scaled = slope / margin[..., None]
    down = weight * scaled.sum(axis=1)
    down = down.at[:, 0].add(0.5 * share * b**-1.5).reshape(-1, len(PLACES), 3)
    down = jnp.einsum("kec,ecs->ks", down, stencils)
    curvature = weight * jnp.einsum("kmc,kmd->kcd", scaled, scaled)
    if exact:
        curvature = curvature.at[:, 0, 0].add(-0.75 * weight * b**-2 * (1.0 / margin[:, rows.fixed.shape[1] :]).sum(1))
    curvature = curvature.at[:, 0, 0].add(0.75 * share * b**-2.5).reshape(-1, len(PLACES), 3, 3)
    curvature = jnp.einsum("ecs,kecd,edt->kst", stencils, curvature, stencils)
    diagonal, one, two = _bands(curvature)
    ends = 1.0 / square, -1.0 / (_MOST - square)
    diagonal = diagonal + weight * (ends[0] ** 2 + ends[1] ** 2)
    bands = jax.lax.stop_gradient((diagonal, one, two))
    move = _solve_banded(*bands, _added(down) + weight * (ends[0] + ends[1]))
    taken = jnp.max(-jnp.einsum("kmc,kc->km", scaled, _values(move, width)))
    return move, jnp.maximum(taken, jnp.maximum(jnp.max(-move * ends[0]), jnp.max(-move * ends[1])))


def _linear_margins(rows: Rows, values: Float[Array, "P 3"]) -> tuple[Float[Array, "P m"], Float[Array, "P m 3"]]:
    """Return the margins of all rows, and their slopes by (b, b', b''), those of jerk by the tangent of 1 / sqrt(b)."""
    root = jnp.sqrt(values[:, :1, None])
    shrink = jnp.zeros_like(rows.jerk).at[..., 0].set(0.5 / values[:, :1])
    slopes = -rows.fixed, -shrink - root * rows.jerk, -shrink + root * rows.jerk
    return jnp.concatenate(_margins(rows, values), axis=1), jnp.concatenate(slopes, axis=1)


def _added(cells: Float[Array, "K 3"]) -> Float[Array, " K2"]:
    """Return the sums of what the cells contribute to their three coefficients."""
    return sum(jnp.pad(cells[:, i], (i, 2 - i)) for i in range(3))  # pyright: ignore


def _bands(cells: Float[Array, "K 3 3"]) -> tuple[Array, Array, Array]:
    """Return the diagonal and the two bands left of it, by rows. Each (K + 2,)."""
    diagonal = _added(jnp.diagonal(cells, axis1=1, axis2=2))
    one = jnp.pad(cells[:, 0, 1], (1, 1)) + jnp.pad(cells[:, 1, 2], (2, 0))
    return diagonal, one, jnp.pad(cells[:, 0, 2], (2, 0))


def _solve_banded(diagonal: Array, one: Array, two: Array, right: Float[Array, " K2"]) -> Float[Array, " K2"]:
    """Return the solution of a symmetric positive system with five bands, by its factors L D L'."""

    def forward(carry: Any, row: Any) -> tuple[Any, Any]:
        (pivot, near, y), (pivot_2, y_2) = carry
        entry, below, below_2, value = row
        far = below_2 / pivot_2
        own_near = (below - below_2 * near) / pivot
        own = entry - own_near**2 * pivot - far**2 * pivot_2
        own_y = value - own_near * y - far * y_2
        return ((own, own_near, own_y), (pivot, y)), (own_near, far, own_y / own)

    def backward(carry: Any, row: Any) -> tuple[Any, Any]:
        (x, x_2), (near, far, value) = carry, row
        own = value - near * x - far * x_2
        return (own, x), own

    unit, zero = jnp.ones((), right.dtype), jnp.zeros((), right.dtype)
    start = (unit, zero, zero), (unit, zero)
    near, far, value = jax.lax.scan(forward, start, (diagonal, one, two, right))[1]
    rows = jnp.append(near[1:], 0.0), jnp.append(far[2:], jnp.zeros(2, far.dtype)), value
    return jax.lax.scan(backward, (zero, zero), rows, reverse=True)[1]
