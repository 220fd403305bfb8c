"""The floor under a clip: flat, but where what stands says that it is tilted, or that its height drifts."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ._contact import HEIGHT, find_contact, find_ground, mean_over, noise_steps

_LOW = 0.1
"""The floor is what this share of the points that stand is below of."""
_OFF = 0.1
"""A floor is not flat where more of what is still than this share is higher above it than what stands."""
_HALF = 0.5
"""How much less another floor has to leave unexplained."""
_SECONDS, _MOST = 1.0, 2000
_STEEPEST, _FASTEST = 0.1, 0.1
_ITERATIONS, _SMALLEST = 60, 1e-4


@dataclasses.dataclass(frozen=True)
class Floor:
    """Height of the floor at each place and time.

    Attributes:
        height: at the origin, in the first frame [m].
        slope: along x and y [m/m].
        drift: over time [m/s].
    """

    height: float
    slope: tuple[float, float] = (0.0, 0.0)
    drift: float = 0.0

    def under(self, points: Float[np.ndarray, "F ... 3"], fps: float) -> Float[np.ndarray, "F ..."]:
        """Height of the floor under each point [m]."""
        time = (np.arange(len(points)) / fps).reshape(-1, *[1] * (points.ndim - 2))
        return self.height + points[..., :2] @ np.array(self.slope) + self.drift * time

    def leveled(self, points: Float[np.ndarray, "F ... 3"], fps: float) -> Float[np.ndarray, "F ... 3"]:
        """The points with heights above the floor."""
        return np.concatenate([points[..., :2], points[..., 2:] - self.under(points, fps)[..., None]], -1)


def find_floor(points: Float[np.ndarray, "F k 3"], fps: float, noise: float) -> Floor:
    """The floor that some points, heels and toes, stand on.

    Flat (``find_ground``), unless more than a tenth of what is still, which is a second at least, is more than 4 cm
    above that, and a plane that is tilted by up to 0.1, a height that drifts by up to 0.1 m/s, or both, leaves half as
    many there, and half of the deviations from the floor.

    Args:
        points: [m]
        fps: frames a second.
        noise: standard deviation on each coordinate [m].
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
        better = _deviation(rest) < _HALF * left and np.mean(rest > HEIGHT) < _HALF * off
        if better and np.hypot(*floor.slope) < _STEEPEST and abs(floor.drift) < _FASTEST:
            best, off, left = floor, np.mean(rest > HEIGHT), _deviation(rest)
    return best


def _deviation(rest: Float[np.ndarray, " n"]) -> float:
    """What a quantile makes least: deviations, of which those below it weigh more."""
    return float(np.mean(np.where(rest > 0.0, _LOW, _LOW - 1.0) * rest))


def _fitted(
    places: Float[np.ndarray, "n 2"], height: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], columns: list[int]
) -> Floor:
    """The floor of which ``_LOW`` of the heights are below, linear in some of x, y and time.

    By least squares, weighted anew by their residuals until these are summed and not squared.
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
