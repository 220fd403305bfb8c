"""Detection of heel and toe contacts in clips without labels: points that are low and slow within the noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaincinv

# Thresholds for a person on a level floor: height [m] and speed [m/s] of a standing point, shortest contact and longest
# gap [s], and motion within a closed gap [m].
HEIGHT = 0.04
SPEED = 0.3
_SHORTEST = 0.06
_STAYS = 0.01
# The floor is a low percentile, not the minimum: single frames may have a foot in the floor.
_LOW_SHARE = 10.0
_FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)
"""Fourth-difference filter, scaled so that it preserves the standard deviation of white noise."""
# Noise is read in the 15 % stillest frames of a point, and from the quieter quarter of the points.
_STILLEST, _POINTS = 0.15, 0.25
_AXES = 3
_SPEED_SHARE = 0.35
"""Largest standard deviation of a speed caused by noise, as a share of the speed threshold."""
_LONGEST = 0.25
_LINE = 0.999
"""Quantile of the chi-square test: residuals from a straight line above it are not attributed to noise."""


def _chi_square(share: float, freedoms: int) -> float:
    """Return the quantile ``share`` of the chi-square distribution with ``freedoms`` degrees of freedom."""
    return 2.0 * float(gammaincinv(0.5 * freedoms, share))


def find_noise(points: Float[np.ndarray, "F k 3"]) -> float:
    """Return the standard deviation of white noise on each coordinate of some points [m].

    It is estimated from fourth differences over the 15 % of frames in which a point moves least, because a standing
    foot shows noise only. The quartile of the quieter points counts. 0 for fewer than five frames.
    """
    if len(points) < len(_FOURTH):
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(points, len(_FOURTH), axis=0)
    change = np.linalg.norm(windows @ _FOURTH, axis=-1)
    return float(np.quantile(np.quantile(change, _STILLEST, axis=0), _POINTS) / np.sqrt(_chi_square(_STILLEST, _AXES)))


def noise_steps(noise: float, fps: float) -> int:
    """Return the number of frame steps over which a speed is measured so that noise is a small share of it.

    A straight line fitted over n steps has a slope whose standard deviation is ``noise * fps / sqrt(n (n + 1) (n + 2) /
    12)``. The result is 1 if that is enough, and at most 0.25 s.
    """
    steps = 1
    while steps < _LONGEST * fps and noise * fps > _SPEED_SHARE * SPEED * np.sqrt(_lever(steps)):
        steps += 1
    return steps


def _lever(steps: int) -> float:
    """Return the sum of squared times of a window's n + 1 frames about its middle, in frames^2."""
    return steps * (steps + 1) * (steps + 2) / 12.0


def find_ground(points: Float[np.ndarray, "F k 3"], steps: int = 1) -> float:
    """Return the floor height [m]: the 10th percentile of the lowest point.

    With noise, heights are averaged over ``steps`` frames (``noise_steps``), because the lowest of noisy heights is
    biased down.
    """
    return float(np.percentile(mean_over(points[..., 2], steps).min(1), _LOW_SHARE))


def mean_over(values: Float[np.ndarray, "F k"], steps: int) -> Float[np.ndarray, "F k"]:
    """Return the moving average over ``steps`` steps around each frame (fewer at the ends); unchanged for one step."""
    if steps == 1 or len(values) <= steps:
        return values
    before, after = (steps + 1) // 2, steps // 2
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    at = np.arange(len(values))
    first, last = np.maximum(at - before, 0), np.minimum(at + after + 1, len(values))
    return (total[last] - total[first]) / (last - first)[:, None]


def find_contact(
    points: Float[np.ndarray, "F k 3"], fps: float, ground: float, *, noise: float = 0.0
) -> Bool[np.ndarray, "F k"]:
    """Return whether each point stands on the ground. (F, k).

    A point stands if it is lower than 4 cm above the ground and slower than 0.3 m/s, both since the frame before and
    until the frame after. With noise, each step becomes a window of ``noise_steps``: in at least two of the
    windows that contain a frame, a line fitted to the point's positions must be slow, and noise must explain the
    residuals. So landing and lifting are found to the frame.

    Gaps of up to 0.06 s (or one window) plus a frame are closed if the point stays low and returns to its place within
    1 cm. Contacts shorter than 0.06 s are dropped. Points, ground and noise (the standard deviation of each coordinate,
    ``find_noise``) are in metres.
    """
    steps = min(noise_steps(noise, fps), max(len(points) - 1, 1))
    low = mean_over(points[..., 2], steps) - ground < HEIGHT
    stands = low & _still(points, fps, noise, steps)
    # a contact lasts two frames at least, also at low rates
    least = max(2, round(_SHORTEST * fps))
    # two means over ``steps`` frames differ by noise with a standard deviation of noise * sqrt(2 / steps) per axis
    longest, back = max(least, steps) + 1, _STAYS + 2.0 * noise * np.sqrt(2.0 / steps) * (steps > 1)
    for k in range(points.shape[1]):
        for start, end in stretches(~stands[:, k]):
            inside = start > 0 and end < len(points) and low[start:end, k].all()
            if inside and end - start <= longest:
                before = points[max(start - steps, 0) : start, k].mean(0)
                if np.linalg.norm(points[end : end + steps, k].mean(0) - before) < back:
                    stands[start:end, k] = True
        for start, end in stretches(stands[:, k]):
            if end - start < least:
                stands[start:end, k] = False
    return stands


def _still(points: Float[np.ndarray, "F k 3"], fps: float, noise: float, steps: int) -> Bool[np.ndarray, "F k"]:
    """Return whether at least two windows that contain a frame (or the only one) show a point at rest. (F, k)."""
    frames = len(points)
    if frames == 1:
        return np.zeros(points.shape[:2], bool)
    windows = np.lib.stride_tricks.sliding_window_view(points, steps + 1, axis=0)
    time = np.arange(steps + 1) - 0.5 * steps
    slope = windows @ time / _lever(steps)
    # the threshold is lowered by the variance that noise gives a speed, up to its allowed share
    share = 0.0 if steps == 1 else min((noise * fps) ** 2 / _lever(steps), (_SPEED_SHARE * SPEED) ** 2)
    still = np.sum(slope**2, -1) * fps**2 + share < SPEED**2
    if steps > 1:
        off = windows - windows.mean(-1, keepdims=True) - slope[..., None] * time
        still &= np.sum(off**2, (-1, -2)) < noise**2 * _chi_square(_LINE, _AXES * (steps - 1))
    count, there = np.zeros(points.shape[:2], int), np.zeros((frames, 1), int)
    for k in range(steps + 1):
        count[k : frames - steps + k] += still
        there[k : frames - steps + k] += 1
    return count >= np.minimum(2, there)


def stretches(flag: Bool[np.ndarray, " F"]) -> list[tuple[int, int]]:
    """Return the first frame and the frame after the last of each run of True in a flag."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
