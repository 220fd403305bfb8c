"""Which heels and toes stand, where a clip does not say: those that are low and slow, as far as noise lets one see."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaincinv

HEIGHT = 0.04
SPEED = 0.3
_SHORTEST = 0.06
_STAYS = 0.01
_LOW_SHARE = 10.0
_FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)
"""Fourth differences, scaled so that white noise keeps its size."""
_STILLEST, _POINTS = 0.15, 0.25
_AXES = 3
_SPEED_SHARE = 0.35
"""How large the noise of a speed may be, as a share of the speed that is asked for."""
_LONGEST = 0.25
_LINE = 0.999
"""How sure it is that noise alone does not take points that far from a line, where they are not taken for one."""


def _chi_square(share: float, freedoms: int) -> float:
    """What this share of sums of so many squared normal numbers is below."""
    return 2.0 * float(gammaincinv(0.5 * freedoms, share))


def find_noise(points: Float[np.ndarray, "F k 3"]) -> float:
    """Standard deviation of white noise on each coordinate of some points [m].

    From fourth differences from frame to frame, in the 15 % of the frames in which each point moves least: those of a
    foot that stands are noise alone. The quieter points count. 0 for fewer than five frames.
    """
    if len(points) < len(_FOURTH):
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(points, len(_FOURTH), axis=0)
    change = np.linalg.norm(windows @ _FOURTH, axis=-1)
    return float(np.quantile(np.quantile(change, _STILLEST, axis=0), _POINTS) / np.sqrt(_chi_square(_STILLEST, _AXES)))


def noise_steps(noise: float, fps: float, speed: float = SPEED) -> int:
    """Over how many steps, from one frame to the next, a speed is taken, for noise to be a small share of it.

    A straight line through n steps has a slope whose standard deviation is
    ``noise * fps / sqrt(n (n + 1) (n + 2) / 12)``. 1 where that is enough, and 0.25 s at most.
    """
    steps = 1
    while steps < _LONGEST * fps and noise * fps > _SPEED_SHARE * speed * np.sqrt(_lever(steps)):
        steps += 1
    return steps


def _lever(steps: int) -> float:
    """Sum of the squares of the times of a window's frames, from its middle, in frames."""
    return steps * (steps + 1) * (steps + 2) / 12.0


def find_ground(points: Float[np.ndarray, "F k 3"], steps: int = 1) -> float:
    """Height of the floor: what the lowest of some points is above of in nine frames out of ten [m].

    Heights are means over ``steps`` (``noise_steps``) where these are more than one, since the lowest of noisy heights
    is too low.
    """
    return float(np.percentile(mean_over(points[..., 2], steps).min(1), _LOW_SHARE))


def mean_over(values: Float[np.ndarray, "F k"], steps: int) -> Float[np.ndarray, "F k"]:
    """Means over so many steps around each frame, over those that there are at the ends; as they are for one step."""
    if steps == 1 or len(values) <= steps:
        return values
    before, after = (steps + 1) // 2, steps // 2
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    at = np.arange(len(values))
    first, last = np.maximum(at - before, 0), np.minimum(at + after + 1, len(values))
    return (total[last] - total[first]) / (last - first)[:, None]


def find_contact(
    points: Float[np.ndarray, "F k 3"],
    fps: float,
    ground: float,
    *,
    noise: float = 0.0,
    height: float = HEIGHT,
    speed: float = SPEED,
) -> Bool[np.ndarray, "F k"]:
    """Whether each point stands on the ground.

    A point stands that is nearer to the ground than ``height`` [m] and slower than ``speed`` [m/s], both to the frame
    before and to the one after. With noise, these steps from one frame to the next become longer windows
    (``noise_steps``): in two at least of those that a frame is in, a straight line through the point's places has to be
    slow, and noise has to explain what is off the line. So it is seen to the frame where a foot lands or leaves.

    Gaps of up to 0.06 s, or as long as such a window, and a frame on both sides, in which the point stays low and comes
    back to its place within 1 cm, are closed; what stands for less than 0.06 s is left out.

    Args:
        points: [m]
        fps: frames a second.
        ground: height of the floor [m].
        noise: standard deviation on each coordinate [m] (``find_noise``).
        height: [m]
        speed: [m/s]
    """
    steps = min(noise_steps(noise, fps, speed), max(len(points) - 1, 1))
    low = mean_over(points[..., 2], steps) - ground < height
    stands = low & _still(points, fps, noise, speed, steps)
    least = max(2, round(_SHORTEST * fps))
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


def _still(
    points: Float[np.ndarray, "F k 3"], fps: float, noise: float, speed: float, steps: int
) -> Bool[np.ndarray, "F k"]:
    """Whether at least two of the windows that a frame is in, or the one where there is one, are still."""
    frames = len(points)
    if frames == 1:
        return np.zeros(points.shape[:2], bool)
    windows = np.lib.stride_tricks.sliding_window_view(points, steps + 1, axis=0)
    time = np.arange(steps + 1) - 0.5 * steps
    slope = windows @ time / _lever(steps)
    share = 0.0 if steps == 1 else min((noise * fps) ** 2 / _lever(steps), (_SPEED_SHARE * speed) ** 2)
    still = np.sum(slope**2, -1) * fps**2 + share < speed**2
    if steps > 1:
        off = windows - windows.mean(-1, keepdims=True) - slope[..., None] * time
        still &= np.sum(off**2, (-1, -2)) < noise**2 * _chi_square(_LINE, _AXES * (steps - 1))
    count, there = np.zeros(points.shape[:2], int), np.zeros((frames, 1), int)
    for k in range(steps + 1):
        count[k : frames - steps + k] += still
        there[k : frames - steps + k] += 1
    return count >= np.minimum(2, there)


def stretches(flag: Bool[np.ndarray, " F"]) -> list[tuple[int, int]]:
    """First frame, and the one after the last, of each stretch in which a flag holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
