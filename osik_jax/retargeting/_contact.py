"""Which heels and toes stand, where a clip does not say: those that are low and slow."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

HEIGHT = 0.04
SPEED = 0.3
_SHORTEST = 0.06
_STAYS = 0.01
_LOW_SHARE = 10.0


def find_ground(points: Float[np.ndarray, "F k 3"]) -> float:
    """Height of the floor: what the lowest of some points is above of in nine frames out of ten [m]."""
    return float(np.percentile(points[..., 2].min(1), _LOW_SHARE))


def find_contact(
    points: Float[np.ndarray, "F k 3"], fps: float, ground: float, *, height: float = HEIGHT, speed: float = SPEED
) -> Bool[np.ndarray, "F k"]:
    """Whether each point stands on the ground.

    A point stands that is nearer to the ground than ``height`` [m] and slower than ``speed`` [m/s], both to the frame
    before and to the one after. Gaps of up to 0.06 s and a frame on both sides, in which it stays low and comes back to
    its place within 1 cm, are closed; what stands for less than 0.06 s is left out.
    """
    low = points[..., 2] - ground < height
    slow = np.zeros(points.shape[:2], bool)
    if len(points) > 1:
        rate = np.linalg.norm(np.diff(points, axis=0), axis=-1) * fps
        slow = np.maximum(np.concatenate([rate[:1], rate]), np.concatenate([rate, rate[-1:]])) < speed
    stands, least = low & slow, max(2, round(_SHORTEST * fps))
    for k in range(points.shape[1]):
        for start, end in _stretches(~stands[:, k]):
            inside = start > 0 and end < len(points) and low[start:end, k].all()
            if inside and end - start <= least + 1 and np.linalg.norm(points[end, k] - points[start - 1, k]) < _STAYS:
                stands[start:end, k] = True
        for start, end in _stretches(stands[:, k]):
            if end - start < least:
                stands[start:end, k] = False
    return stands


def _stretches(flag: Bool[np.ndarray, " F"]) -> list[tuple[int, int]]:
    """First frame, and the one after the last, of each stretch in which a flag holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
