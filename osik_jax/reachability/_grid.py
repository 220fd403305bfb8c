"""Grid of positions over a frame's workspace, and the orientations tried at each."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..kinematics._rigid import rotation_matrix
from ..numerics._arguments import check_count
from ._frame import Frame

Grid = tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"], Float[np.ndarray, " nz"]]
"""Coordinates of the positions along x, y and z, world axes, increasing [m]."""

_SAMPLES = 4096
_MARGIN = 0.05
"""Margin of the grid around the sampled positions, as a fraction of the longest side: no sample lies quite at the edge.
"""
_FLAT = 1e-6
"""Share of the longest side below which a side is a rounding."""
_FIRST = np.sqrt(2.0)
_SECOND = 1.533751168755204288118041413
"""The positive root of x**4 = x + 4. It and the square root of 2 are the windings for which the points are spread most
evenly."""


def around(frame: Frame, positions: int) -> Grid:
    """Return a grid with equal spacing along x, y and z over the bounding box of a frame's workspace.

    The box is that of 4,096 configurations which fill the joints' ranges evenly, and a margin. A side along which the
    frame never moves, as a planar arm's, is a single coordinate. There are at most ``positions``; that number is nearly
    reached.
    """
    check_count("positions", positions)
    places = np.asarray(frame.sampled_positions(_SAMPLES))
    low, high = places.min(0), places.max(0)
    longest = float((high - low).max())
    margin = np.where(high - low > _FLAT * longest, _MARGIN * longest, 0.0)
    middle, sides = 0.5 * (low + high), np.where(margin > 0.0, high - low + 2.0 * margin, 0.0)
    spacing = _spacing(sides, positions)
    return tuple(_along(at, side, spacing) for at, side in zip(middle, sides, strict=True))  # pyright: ignore


def _spacing(sides: Float[np.ndarray, "3"], positions: int) -> float:
    """Return the smallest spacing that makes at most a number of positions, by bisection."""
    enough, few = 2.0 * float(sides.max()) + 1e-9, 0.0
    for _ in range(60):
        spacing = 0.5 * (enough + few)
        if np.prod([_number(side, spacing) for side in sides]) <= positions:
            enough = spacing
        else:
            few = spacing
    return enough


def _number(side: float, spacing: float) -> float:
    return np.floor(side / spacing) + 1.0


def _along(middle: float, side: float, spacing: float) -> Float[np.ndarray, " n"]:
    number = int(_number(side, spacing))
    return middle + spacing * (np.arange(number) - 0.5 * (number - 1))


def checked_grid(grid: object) -> Grid:
    """Return a checked grid of a user."""
    expected = "it is (x, y, z): the coordinates along each axis, increasing [m]"
    if not isinstance(grid, tuple | list) or len(grid) != 3:
        raise OsikTypeError(f"grid is {grid!r}; {expected}")
    try:
        axes = tuple(np.asarray(axis, float) for axis in grid)
    except (TypeError, ValueError):
        raise OsikTypeError(f"grid is {grid!r}; {expected}") from None
    for name, axis in zip("xyz", axes, strict=True):
        if axis.ndim != 1 or not axis.size or not np.isfinite(axis).all() or not (np.diff(axis) > 0.0).all():
            raise OsikValueError(f"{name} of the grid is {axis}; {expected}")
    return axes  # pyright: ignore[reportReturnType]


def spread(values: np.ndarray, chosen: Bool[np.ndarray, " m"], elsewhere: Any) -> np.ndarray:
    """Return values (k, ...) of the chosen points as those of all points. (m, ...)."""
    whole = np.full((len(chosen), *values.shape[1:]), elsewhere, values.dtype)
    whole[chosen] = values
    return whole


def spread_rotations(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Return evenly spread rotations, one or more; the same ones every time.

    They lie on a spiral around the unit quaternions, at constant density (M. Alexa, "Super-Fibonacci spirals: fast,
    low-discrepancy sampling of SO(3)", CVPR 2022). Sets of different sizes share no rotation.
    """
    along = np.arange(count) + 0.5
    inner, outer = np.sqrt(along / count), np.sqrt(1.0 - along / count)
    alpha, beta = 2.0 * np.pi * along / _FIRST, 2.0 * np.pi * along / _SECOND
    parts = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    return np.asarray(rotation_matrix(jnp.asarray(np.stack(parts, -1))))
