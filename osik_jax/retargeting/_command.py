"""Files of ``osik retarget``, and its film."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.lines import Line2D

from .._whole_file import write_text
from ..robot._mujoco import mujoco_poses
from ..viewer._animate import paint_over, write_gif
from ..viewer._overlay import BLUE, INK, Canvas
from ..viewer._stage import frame_camera
from ._profile_file import save_profile
from ._report import report
from ._retargeted import Retargeted
from ._roles import bones

_AZIMUTH, _ELEVATION, _SIZE = 50.0, 12.0, (640, 360)
"""Angles of the camera [deg]: in front, to the left and above; width and height of the pictures [pixels]."""
_FLOOR = "#9aa3ad"
_RATE = 15.0


def write_folder(result: Retargeted, name: str, out: Path, *, animation: bool) -> dict[str, Any]:
    """Write motion (.npz and .csv), report, profile and optionally a GIF; return the report."""
    figures = {"clip": name, **report(result)}
    write_motion(result, figures, out)
    save_profile(result.profile, out / "profile.toml")
    if animation:
        film(result, out / "motion.gif")
    return figures


def write_motion(result: Retargeted, figures: dict[str, Any], out: Path) -> None:
    """Write ``motion.npz``, ``motion.csv`` and, last of all, ``report.json`` to an existing folder."""
    result.save(out / "motion.npz")
    result.motion.save_csv(out / "motion.csv")
    write_json(figures, out / "report.json")


def write_json(figures: dict[str, Any], path: Path) -> None:
    """Write a JSON file, so that a file of this name is always complete."""
    write_text(path, json.dumps(figures, indent=2, allow_nan=False) + "\n")


def film(result: Retargeted, path: str | os.PathLike[str]) -> Path:
    """Write a GIF: the person on the left, the robot on the right, scaled to the person's height."""
    stride = max(1, round(result.motion.fps / _RATE))
    views = {"person": _person_sticks(result)[::stride], "robot": _robot_sticks(result)[::stride]}
    canvas, tracks = Canvas(_SIZE), []
    for k, ((title, sticks), color) in enumerate(zip(views.items(), (INK, BLUE), strict=True)):
        window = (0.5 * k + 0.02, 0.5 * k + 0.48, 0.12, 0.97)
        camera = frame_camera(sticks.reshape(-1, 3), _SIZE, _AZIMUTH, _ELEVATION, window)
        canvas.page.text(_SIZE[0] * (0.5 * k + 0.25), 22, title, ha="center", fontsize=9, color=INK)
        middle = sticks.mean((0, 1, 2)) * [1.0, 1.0, 0.0]
        floor = camera.project(middle + np.outer([-0.3, 0.3], camera.height * camera.axes[0]), _SIZE)
        canvas.page.plot(*floor.T, color=_FLOOR, lw=0.8)
        lines = [canvas.page.plot([], [], color=color, lw=2.4, solid_capstyle="round")[0] for _ in sticks[0]]
        canvas.moving(*lines)
        tracks += zip(lines, np.moveaxis(camera.project(sticks, _SIZE), 1, 0), strict=True)
    write_gif(Path(path), _pictures(canvas, tracks), stride / result.motion.fps)
    return Path(path)


def _pictures(canvas: Canvas, tracks: Sequence[tuple[Line2D, Float[np.ndarray, "F 2 2"]]]) -> Iterator[np.ndarray]:
    """Yield the pictures of lines, each with its two ends in each frame [pixels]."""
    for frame in range(len(tracks[0][1])):
        for line, ends in tracks:
            line.set_data(*ends[frame].T)
        yield paint_over(np.ones((_SIZE[1], _SIZE[0], 3)), canvas.picture())


def _person_sticks(result: Retargeted) -> Float[np.ndarray, "F k 2 3"]:
    points = {name: result.human[:, k] for k, name in enumerate(result.human_names)}
    return np.stack([np.stack([points[a], points[b]], 1) for a, b in bones(points)], 1)


def _robot_sticks(result: Retargeted) -> Float[np.ndarray, "F k 2 3"]:
    """Return the segment from each moving body to its parent, by MuJoCo's kinematics [m]."""
    parents = result.robot.mj_model.body_parentid
    children = np.flatnonzero(parents)
    poses = mujoco_poses(result.robot, result.q)
    return np.array([np.stack([data.xpos[children], data.xpos[parents[children]]], 1) for data in poses])
