"""Cubic splines through waypoints: paths with continuous second derivatives."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Spline(NamedTuple):
    """Cubic spline with continuous second derivatives.

    Attributes:
        knots: increasing values of the path parameter. (N,)
        coefficients: of the powers 0 to 3 of ``s - knots[i]`` on each segment. (N - 1, 4, n)
    """

    knots: Float[Array, " N"]
    coefficients: Float[Array, "N_1 4 n"]

    def derivatives(self, s: Float[Array, " K"]) -> Float[Array, "4 K n"]:
        """Return the value and the first three derivatives at parameters ``s``."""
        segment = jnp.clip(jnp.searchsorted(self.knots, s, side="right") - 1, 0, len(self.knots) - 2)
        return cubic_derivatives(self.coefficients[segment], (s - self.knots[segment])[:, None])


def cubic_derivatives(coefficients: Array, x: Array) -> Array:
    """Return the value and three derivatives of cubics.

    Args:
        coefficients: of rising powers. (K, 4) or (K, 4, n)
        x: where. (K,) or (K, 1)

    Returns:
        Derivatives 0 to 3. (4, K) or (4, K, n)
    """
    a, b, c, d = (coefficients[:, power] for power in range(4))
    first, second = b + x * (2.0 * c + 3.0 * x * d), 2.0 * c + 6.0 * x * d
    return jnp.stack([a + x * (b + x * (c + x * d)), first, second, 6.0 * d + 0.0 * x])


def chord_lengths(points: Float[Array, "N n"]) -> Float[Array, " N"]:
    """Return path parameters from 0 to 1 that grow with the distance of waypoints [rad or m]."""
    steps = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    along = jnp.concatenate([jnp.zeros(1, points.dtype), jnp.cumsum(steps)])
    return along / along[-1]


def spline_through(points: Float[Array, "N n"], knots: Float[Array, " N"]) -> Spline:
    """Return the not-a-knot spline through waypoints: a line through two, a parabola through three."""
    width = jnp.diff(knots)[:, None]
    slope = jnp.diff(points, axis=0) / width
    bend = _second_derivatives(width[:, 0], slope)
    linear = slope - width * (2.0 * bend[:-1] + bend[1:]) / 6.0
    coefficients = points[:-1], linear, bend[:-1] / 2.0, jnp.diff(bend, axis=0) / (6.0 * width)
    return Spline(knots, jnp.stack(coefficients, axis=1))


def _second_derivatives(width: Float[Array, " M"], slope: Float[Array, "M n"]) -> Float[Array, "M1 n"]:
    """Return the second derivatives at the knots, whose third derivative is continuous at both inner end knots."""
    if len(width) == 1:
        return jnp.zeros((2, slope.shape[1]), slope.dtype)
    right = 6.0 * jnp.diff(slope, axis=0)
    if len(width) == 2:
        return jnp.repeat(right / (3.0 * width.sum()), 3, axis=0)
    first, last = width[0] / width[1], width[-1] / width[-2]
    diagonal = 2.0 * (width[:-1] + width[1:])
    diagonal = diagonal.at[0].add(width[0] * (1.0 + first)).at[-1].add(width[-1] * (1.0 + last))
    upper = width[1:].at[0].add(-width[0] * first).at[-1].set(0.0)
    lower = width[:-1].at[-1].add(-width[-1] * last).at[0].set(0.0)
    inner = jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, right)
    start = inner[0] * (1.0 + first) - inner[1] * first
    end = inner[-1] * (1.0 + last) - inner[-2] * last
    return jnp.concatenate([start[None], inner, end[None]])
