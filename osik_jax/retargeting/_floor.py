"""Floor under a clip: flat, unless the standing points show a slope or a drift of its height."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ._contact import HEIGHT, find_contact, find_ground, mean_over, noise_steps

_LOW = 0.1
"""Quantile of standing points' heights that defines the floor."""
_OFF = 0.1
"""Largest share of resting points over 4 cm above a flat floor; above it a sloped or drifting floor is tried."""
_HALF = 0.5
"""A sloped or drifting floor is accepted if it leaves less than this share of the flat floor's residuals."""
# A floor is fitted to at least 1 s of resting points, and to at most 2,000 of them, which bounds the cost.
_SECONDS, _MOST = 1.0, 2000
# Largest slope [m/m] and drift [m/s] of a floor that is accepted.
_STEEPEST, _FASTEST = 0.1, 0.1
# Residuals below 0.1 mm are treated as 0.1 mm in the reweighting, whose weights would be infinite otherwise.
_ITERATIONS, _SMALLEST = 60, 1e-4


@dataclasses.dataclass(frozen=True)
class Floor:
    """Height of the floor as a linear function of place and time."""

    height: float  # height at the origin in the first frame [m]
    slope: tuple[float, float] = (0.0, 0.0)  # slope along x and y [m/m]
    drift: float = 0.0  # change of height over time [m/s]

    def under(self, points: Float[np.ndarray, "F ... 3"], fps: float) -> Float[np.ndarray, "F ..."]:
        """Return the height of the floor under each point [m]."""
        time = (np.arange(len(points)) / fps).reshape(-1, *[1] * (points.ndim - 2))
        return self.height + points[..., :2] @ np.array(self.slope) + self.drift * time

    def leveled(self, points: Float[np.ndarray, "F ... 3"], fps: float) -> Float[np.ndarray, "F ... 3"]:
        """Return the points with z replaced by the height above the floor [m]."""
        return np.concatenate([points[..., :2], points[..., 2:] - self.under(points, fps)[..., None]], -1)


def find_floor(points: Float[np.ndarray, "F k 3"], fps: float, noise: float) -> Floor:
    """Return the floor that heels and toes stand on.

    The floor is flat (``find_ground``) by default. If over a tenth of at least 1 s of resting points lie more than 4 cm
    above it, a plane with slope up to 0.1, a drift up to 0.1 m/s, or both are fitted. A fit is accepted if it halves
    both that share and the quantile loss. Points and noise (the standard deviation of each coordinate) are in metres.
    """
    steps = noise_steps(noise, fps)
    flat = Floor(find_ground(points, steps))
    frames, which = np.nonzero(find_contact(points, fps, 0.0, noise=noise, height=np.inf))
    if len(frames) < _SECONDS * fps:
        return flat
    some = np.unique(np.linspace(0, len(frames) - 1, _MOST).astype(int))
    places, time = points[frames[some], which[some], :2], frames[some] / fps
    height = mean_over(points[..., 2], steps)[frames[some], which[some]]
    off, left = np.mean(height - flat.height > HEIGHT), _deviation(height - np.quantile(height, _LOW))
    if off <= _OFF:
        return flat
    best = flat
    for columns in ([0, 1], [2], [0, 1, 2]):
        floor = _fitted(places, height, time, columns)
        rest = height - floor.height - places @ np.array(floor.slope) - floor.drift * time
        # each further column must halve the residual again, so that the simplest sufficient floor wins
        better = _deviation(rest) < _HALF * left and np.mean(rest > HEIGHT) < _HALF * off
        if better and np.hypot(*floor.slope) < _STEEPEST and abs(floor.drift) < _FASTEST:
            best, off, left = floor, np.mean(rest > HEIGHT), _deviation(rest)
    return best


def _deviation(rest: Float[np.ndarray, " n"]) -> float:
    """Return the mean quantile (pinball) loss of residuals; deviations below the quantile weigh more."""
    return float(np.mean(np.where(rest > 0.0, _LOW, _LOW - 1.0) * rest))


def _fitted(
    places: Float[np.ndarray, "n 2"], height: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], columns: list[int]
) -> Floor:
    """Return the 10 % quantile regression of the heights, linear in some of x, y and time.

    Solved by iteratively reweighted least squares.
    """
    all_columns = np.column_stack([places, time])[:, columns]
    middle = all_columns.mean(0)
    matrix = np.column_stack([np.ones(len(time)), all_columns - middle])
    found = np.linalg.lstsq(matrix, height)[0]
    for _ in range(_ITERATIONS):
        rest = height - matrix @ found
        root = np.sqrt(np.where(rest > 0.0, _LOW, 1.0 - _LOW) / np.maximum(np.abs(rest), _SMALLEST))
        found = np.linalg.lstsq(root[:, None] * matrix, root * height)[0]
    linear = np.zeros(3)
    linear[columns] = found[1:]
    return Floor(float(found[0] - middle @ found[1:]), (float(linear[0]), float(linear[1])), float(linear[2]))
