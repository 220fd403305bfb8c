"""Path of a person in a clip whose origin is the middle of the hips, as most pose estimators give it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from .._errors import warn
from ._contact import find_noise, mean_over, noise_steps
from ._motion import HumanMotion
from ._roles import SIDES

_CENTERED = 0.02
"""Largest distance of the middle of the hips from the origin in all frames of such a clip [m]."""


def with_path(motion: HumanMotion, roles: Mapping[str, str]) -> HumanMotion:
    """Return a clip with the person's path, if it has the middle of the hips at the origin; else the clip.

    The lowest of heels and toes (of ankles without these) is on the floor in each frame, and does not move to the next.
    So a jump has no flight. An ``OsikWarning`` says that the path is inferred.

    Args:
        motion: the clip, z up.
        roles: joint name of the clip for each role (``find_roles``).
    """
    points = {role: motion.track(name) for role, name in roles.items()}
    ends = [f"{side}_{part}" for side in SIDES for part in ("heel", "toe")]
    ends = [role for role in ends if role in points] or [f"{side}_ankle" for side in SIDES]
    if not {*ends, "left_hip", "right_hip"} <= set(points):
        return motion
    if np.linalg.norm(points["left_hip"] + points["right_hip"], axis=-1).max() > 2.0 * _CENTERED:
        return motion
    feet = np.stack([points[role] for role in ends], 1)
    steps = noise_steps(find_noise(feet), motion.fps)
    feet = mean_over(feet.reshape(motion.frames, -1), steps).reshape(feet.shape)
    # a point that stands is among the lowest before and after a step
    lowest = np.maximum(feet[:-1, :, 2], feet[1:, :, 2]).argmin(1)
    path = np.zeros((motion.frames, 3))
    path[1:] = -np.cumsum(np.diff(feet, axis=0)[np.arange(len(lowest)), lowest], 0)
    path[:, 2] = -feet[..., 2].min(1)
    warn(f"{motion.name} has the hips at the origin in all frames; its path is inferred from the lowest foot")
    moved = {name: poses + np.pad(path, ((0, 0), (0, 4))) for name, poses in motion.objects.items()}
    return dataclasses.replace(motion, positions=motion.positions + path[:, None], objects=moved)
