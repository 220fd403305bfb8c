"""Pictures and films of motions."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError
from .._whole_file import whole_file
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints
from ._motion import Motion

_RATES = "velocity", "acceleration"


def draw_motion(motion: Motion, path: str | os.PathLike[str], limits: Float[np.ndarray, "3 n"] | None = None) -> None:
    """Write a picture of the joints' speeds and accelerations, by their limits where these are finite.

    Args:
        motion: the motion.
        path: file of the picture, such as ``motion.png``.
        limits: of speed, acceleration and jerk, such as ``Timing.limits``. Default: none.
    """
    from matplotlib.figure import Figure

    time = np.asarray(motion.time)
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    rows: Any = figure.subplots(2, 1, sharex=True)
    for axes, kind, row in zip(rows, _RATES, (0, 1), strict=True):
        limit = np.full(motion.position.shape[1], np.inf) if limits is None else np.asarray(limits)[row]
        known = np.isfinite(limit)
        values = np.asarray(getattr(motion, kind)) / np.where(known, limit, 1.0)
        for joint, name in enumerate(motion.joints or map(str, range(len(limit)))):
            axes.plot(time, values[:, joint], label=name, linestyle="-" if known[joint] else ":")
        if known.any():
            axes.axhline(1.0, color="black", linewidth=0.8)
            axes.axhline(-1.0, color="black", linewidth=0.8)
        axes.set_ylabel(f"{kind} / limit" if known.all() else kind)
    rows[1].set_xlabel("time [s]")
    rows[0].legend(fontsize="small", ncols=4)
    with whole_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:] or "png", dpi=120)


def film_motion(
    motion: Motion,
    robot: Robot,
    path: str | os.PathLike[str],
    limits: Float[np.ndarray, "3 n"] | None = None,
    *,
    frames_per_second: float = 12.5,
    **options: Any,
) -> None:
    """Write a film of the robot, with the largest speed and acceleration of its joints by their limits.

    Args:
        motion: the motion.
        robot: the robot, whose joints are those of the motion.
        path: file of the film, a ``.gif``, or an ``.mp4`` if the program ffmpeg is installed.
        limits: of speed, acceleration and jerk, such as ``Timing.limits``. Default: no curves.
        frames_per_second: pictures of a second of the motion.
        options: those of ``osik_jax.viewer.animate``, such as ``trails=["hand"]`` and ``size=(1280, 720)``.

    Raises:
        ValueError: another robot, or what ``animate`` does not allow.
        OSError: the file cannot be written.
    """
    from ..viewer import animate

    check_scalar_joints(robot, "a film of a motion")
    if motion.position.shape[1] != robot.nq:
        raise OsikValueError(
            f"the motion has {motion.position.shape[1]} joints, and the robot {robot.nq}: give its robot"
        )
    time, dt = np.asarray(motion.time), 1.0 / frames_per_second
    shown = np.append(np.arange(time[0], time[-1], dt), time[-1])
    q, *rates = (_at_times(shown, time, np.asarray(getattr(motion, kind))) for kind in ("position", *_RATES))
    if limits is not None:
        used = [(np.abs(rate) / limit).max(axis=1) for rate, limit in zip(rates, np.asarray(limits), strict=False)]
        curves = dict(zip(("speed", "acceleration"), used, strict=True))
        options = {"curves_title": "largest by its limit", **options, "curves": curves}
    animate(Path(path), robot, q, dt=dt, frames_per_second=frames_per_second, **options)


def _at_times(shown: np.ndarray, time: np.ndarray, values: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "K n"]:
    """Return values at other times, between two samples linear."""
    return np.stack([np.interp(shown, time, own) for own in values.T], axis=1)
