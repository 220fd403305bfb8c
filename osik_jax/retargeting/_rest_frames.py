"""Frames at the start of a clip that show the rest pose and no motion."""

from __future__ import annotations

import numpy as np

from ._motion import HumanMotion

_LIKE = np.radians(30.0)
"""How far joints are turned beside the root at most in what is taken for the rest pose: CMU's files have legs 21
degrees from it in their first frame [rad]."""
_FASTEST = 5.0
"""Speed of a joint beside the root above which the step out of the rest pose may be a jump [m/s]."""
_ABOVE_ALL = 3.0
"""By how much that step is longer than any other of the clip, at least."""


def rest_frames(motion: HumanMotion) -> int:
    """How many frames at the start of a clip are the rest pose, put before the motion: 0 but where that is sure.

    All joints are turned as the root there, within 30 degrees, and a jump comes after them: from the last of them to
    the next frame a joint moves beside the root at more than 5 m/s, and three times as far as in any other step of the
    clip. So a person who stands in the rest pose and goes on from there loses no frame. Where rotations or the rest
    pose are not known it is 0.
    """
    turns = motion.rotations
    if turns is None or motion.rest_positions is None or motion.frames < 3:
        return 0
    beside = motion.positions - motion.positions[:, :1]
    steps = np.linalg.norm(np.diff(beside, axis=0), axis=-1).max(1)
    count = int(np.argmax(steps)) + 1
    others = np.delete(steps, count - 1)
    jumps = steps[count - 1] * motion.fps > _FASTEST and steps[count - 1] > _ABOVE_ALL * others.max()
    alike = np.abs(np.sum(turns * turns[:, :1], -1)).min(1) > np.cos(0.5 * _LIKE)
    return count if jumps and motion.frames - count > 1 and alike[:count].all() and not alike[count] else 0
