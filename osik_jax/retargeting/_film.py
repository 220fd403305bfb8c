"""Animated GIF of the person and the robot as stick figures, side by side."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ._retargeted import Retargeted
from ._robot_motion import in_model
from ._roles import bones

_AZIMUTH, _ELEVATION = np.radians(50.0), np.radians(12.0)
_INK, _BLUE, _GREY = "#1f2933", "#1565c0", "#9aa3ad"
_RATE = 15.0


def film(result: Retargeted, path: str | os.PathLike[str]) -> Path:
    """Write a GIF: the person on the left, the robot on the right, scaled to the person's height.

    Args:
        result: the retargeted motion.
        path: of the ``.gif``.
    """
    stride = max(1, round(result.motion.fps / _RATE))
    person = _person_sticks(result)[::stride]
    robot = _robot_sticks(result)[::stride]
    # the guard keeps a robot that lies flat in the first frame finite
    robot = robot * (np.ptp(person[0, ..., 2]) / max(np.ptp(robot[0, ..., 2]), 1e-6))
    views = [_projected(sticks) for sticks in (person, robot)]
    figure = Figure(figsize=(6.4, 3.6), dpi=100)
    canvas = FigureCanvasAgg(figure)
    drawn = []
    for k, (view, title, color) in enumerate(zip(views, ("person", "robot"), (_INK, _BLUE), strict=True)):
        axes = figure.add_axes((0.5 * k, 0.0, 0.5, 0.92))
        axes.set_title(title, fontsize=9, color=_INK)
        axes.axis("off")
        axes.set_aspect("equal")
        middle, half = 0.5 * (view.min((0, 1, 2)) + view.max((0, 1, 2))), 0.55 * np.ptp(view, axis=(0, 1, 2)).max()
        axes.set_xlim(middle[0] - half, middle[0] + half)
        axes.set_ylim(middle[1] - half, middle[1] + half)
        axes.axhline(0.0, color=_GREY, lw=0.8)
        drawn.append([axes.plot([], [], color=color, lw=2.4, solid_capstyle="round")[0] for _ in range(view.shape[1])])
    pictures = []
    for f in range(len(person)):
        for lines, view in zip(drawn, views, strict=True):
            for line, ends in zip(lines, view[f], strict=True):
                line.set_data(ends[:, 0], ends[:, 1])
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    wait = round(1000.0 * stride / result.motion.fps)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=wait, loop=0)
    return Path(path)


def _person_sticks(result: Retargeted) -> Float[np.ndarray, "F k 2 3"]:
    points = {name: result.human[:, k] for k, name in enumerate(result.human_names)}
    return np.stack([np.stack([points[a], points[b]], 1) for a, b in bones(points)], 1)


def _robot_sticks(result: Retargeted) -> Float[np.ndarray, "F k 2 3"]:
    """Return the segment from each moving body to its parent, by MuJoCo's kinematics [m]."""
    model = result.robot.mj_model
    data, sticks = mujoco.MjData(model), []
    children = [b for b in range(1, model.nbody) if model.body_parentid[b] != 0]
    parents = [model.body_parentid[b] for b in children]
    for qpos in in_model(result.robot, result.q):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        sticks.append(np.stack([data.xpos[children], data.xpos[parents]], 1))
    return np.array(sticks)


def _projected(points: Float[np.ndarray, "F k 2 3"]) -> Float[np.ndarray, "F k 2 2"]:
    """Return points projected to the picture plane, seen from the front left and above; the floor is at height 0."""
    across = -np.sin(_AZIMUTH) * points[..., 0] + np.cos(_AZIMUTH) * points[..., 1]
    away = np.cos(_AZIMUTH) * points[..., 0] + np.sin(_AZIMUTH) * points[..., 1]
    middle = away.mean(axis=(1, 2), keepdims=True)
    return np.stack([across, np.cos(_ELEVATION) * points[..., 2] - np.sin(_ELEVATION) * (away - middle)], -1)
