"""Whole motions as messages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import _messages as messages

if TYPE_CHECKING:
    from ...motion import Motion


def joint_trajectory(motion: Motion) -> Any:
    """Return a motion as a ``trajectory_msgs/JointTrajectory``, a point for each sample, times from the first on.

    Its joints have names.
    """
    rows = zip(*(np.asarray(a).tolist() for a in (motion.position, motion.velocity, motion.acceleration)), strict=True)
    nanoseconds = np.rint(1e9 * np.asarray(motion.time - motion.time[0])).astype(np.int64)
    points = []
    for row, due in zip(rows, nanoseconds.tolist(), strict=True):
        seconds, rest = divmod(due, 1_000_000_000)
        points.append(messages.JointTrajectoryPoint(*row, time_from_start=messages.Duration(seconds, rest)))
    return messages.JointTrajectory(messages.Header(), list(motion.joints), points)
