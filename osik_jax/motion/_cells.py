"""Progress along a path in time, in closed form on each cell of a grid."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics._guarded import positive_root
from ._spline import cubic_derivatives

_FLAT = 1e-12
"""Least slope of s(x) of which an inverse is taken."""


class Cells(NamedTuple):
    """Path parameter s as a function of time: a cubic s(x) on each cell, where ``(dx/dt)^2`` is a quadratic in x.

    The cells of a least-time motion under limits of acceleration have s(x) = s0 + x. Those of one under limits of jerk
    have a smooth reference motion s(x), whose time x is stretched or shrunk.

    Attributes:
        start: time at the start of each cell, and at the end of the last one [s]. (K + 1,)
        width: width of each cell in x. (K,)
        path: coefficients of s(x), rising powers of x, which is 0 at the start of each cell. (K, 4)
        square: coefficients of ``(dx/dt)^2``, rising powers of x. (K, 3)
    """

    start: Float[Array, " K1"]
    width: Float[Array, " K"]
    path: Float[Array, "K 4"]
    square: Float[Array, "K 3"]

    def at(self, time: Float[Array, " T"]) -> Float[Array, "4 T"]:
        """Return s and its first three derivatives by time."""
        cell = jnp.clip(jnp.searchsorted(self.start, time, side="right") - 1, 0, len(self.width) - 1)
        elapsed = jnp.clip(time, self.start[0], self.start[-1]) - self.start[cell]
        return _progress(self.path[cell], self.square[cell], _position(self.square[cell], elapsed))

    def inside(self, fraction: Array | float) -> Float[Array, "4 K"]:
        """Return s and its derivatives by time in each cell, at a fraction of its width."""
        return _progress(self.path, self.square, fraction * self.width)

    def through(self, s: Float[Array, " N"]) -> Float[Array, "4 N"]:
        """Return s and its derivatives by time where s has given values, found by bisection."""
        cell = jnp.clip(jnp.searchsorted(self.path[:, 0], s, side="right") - 1, 0, len(self.width) - 1)

        def halved(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (ends[0] + ends[1])
            is_before = cubic_derivatives(self.path[cell], middle)[0] < s
            return jnp.where(is_before, middle, ends[0]), jnp.where(is_before, ends[1], middle)

        ends = jax.lax.stop_gradient((jnp.zeros_like(s), self.width[cell]))
        x = jax.lax.fori_loop(0, 50, halved, ends)[1]
        # moves by nothing, and has the derivative of the inverse function
        reached, slope = cubic_derivatives(self.path[cell], x)[:2]
        x -= (reached - s) / jnp.maximum(jax.lax.stop_gradient(slope), _FLAT)
        return _progress(self.path[cell], self.square[cell], x)

    def slower(self, factor: Float[Array, ""]) -> Cells:
        """Return the same progress with all times multiplied by a factor."""
        return self._replace(start=self.start * factor, square=self.square / factor**2)


def timed(
    width: Float[Array, " K"], path: Float[Array, "K 4"], square: Float[Array, "K 3"], last: Float[Array, ""]
) -> Cells:
    """Return cells with the times that follow from their squared rates, the last of which is at the end."""
    start = jnp.concatenate([jnp.zeros(1, width.dtype), jnp.cumsum(durations(width, square, last))])
    return Cells(start, width, path, square)


def durations(width: Float[Array, " K"], square: Float[Array, "K 3"], last: Float[Array, ""]) -> Float[Array, " K"]:
    """Return the time that x takes through each cell.

    The integral of 1 / sqrt(quadratic) is ``2 artanh(sqrt(c) w / S) / sqrt(c)`` with the curvature c and the sum S of
    the rates at both ends; the series in ``c w^2 / S^2``, which is small, holds for both signs of c. The rate at the
    end of a cell is that of the next one: the polynomial's own value is 0 at rest by cancellation alone, and the root
    of its rounding is noise.
    """
    rate, bend = positive_root(jnp.append(square[:, 0], last)), square[:, 2]
    mean_time = width / (rate[:-1] + rate[1:])
    y = bend * mean_time**2
    return 2.0 * mean_time * (1.0 + y / 3.0 + y**2 / 5.0 + y**3 / 7.0 + y**4 / 9.0)


def _position(square: Float[Array, "T 3"], elapsed: Float[Array, " T"]) -> Float[Array, " T"]:
    """Return x after a time in its cell: the solution of ``x'' = slope / 2 + bend x``, by power series."""
    first, slope, bend = square.T
    y = bend * elapsed**2
    sinh = 1.0 + y / 6.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0 * (1.0 + y / 72.0)))
    cosh = 1.0 + y / 12.0 * (1.0 + y / 30.0 * (1.0 + y / 56.0 * (1.0 + y / 90.0)))
    return elapsed * (positive_root(first) * sinh + slope * elapsed / 4.0 * cosh)


def _progress(path: Float[Array, "T 4"], square: Float[Array, "T 3"], x: Float[Array, " T"]) -> Float[Array, "4 T"]:
    """Return s and its derivatives by time at places x of cells."""
    s, d1, d2, d3 = cubic_derivatives(path, x)
    first, slope, bend = square.T
    rate_squared = jnp.maximum(first + x * (slope + x * bend), 0.0)
    rate, pull = positive_root(rate_squared), slope / 2.0 + bend * x
    jerk = rate * (d3 * rate_squared + 3.0 * d2 * pull + d1 * bend)
    return jnp.stack([s, d1 * rate, d2 * rate_squared + d1 * pull, jerk])
