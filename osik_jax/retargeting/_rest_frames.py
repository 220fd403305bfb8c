"""Frames at the start of a clip that show the rest pose and no motion."""

from __future__ import annotations

import numpy as np

from ._motion import HumanMotion

_LIKE = np.radians(30.0)
"""Largest rotation of a joint relative to the root in a frame taken for the rest pose [rad]; legs in CMU files have 21
degrees in their first frame.
"""
_FASTEST = 5.0
"""Speed of a joint relative to the root above which the step out of the rest pose counts as a jump [m/s]."""
_ABOVE_ALL = 3.0
"""Least ratio of that step to every other step of the clip."""


def rest_frames(motion: HumanMotion) -> int:
    """Return the number of rest-pose frames put before a clip's motion; 0 unless that is certain.

    In these frames all joints are rotated as the root within 30 degrees. The step to the next frame moves a joint
    relative to the root at over 5 m/s, and three times farther than any other step of the clip. So a person who starts
    from the rest pose loses no frame. 0 if rotations or the rest pose are unknown.
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
