"""Export of a motion as one HTML page that plays without a server or network."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..._errors import OsikValueError
from ...control import Trajectory
from ...robot import Robot
from ._playback import Cast, Motion
from ._server import close_server, open_server

_PICTURES = 30.0
"""Number of pictures kept per second."""


def export_html(
    robot: Robot,
    trajectory: Trajectory | ArrayLike | Mapping[str, ArrayLike],
    path: str | os.PathLike[str],
    *,
    dt: float | None = None,
    title: str = "osik-jax",
) -> Path:
    """Write a motion as one self-contained page with time slider, speeds and a mouse-controlled camera.

    Everything is in the file, which any browser with WebGL plays offline; it is about 1 MB and what the robot's meshes
    take.

    Args:
        robot: the robot.
        trajectory: of ``rollout``, or configurations (T, nq), or several of them by name, side by side.
        path: of the page.
        dt: time between configurations [s]; default: that of the trajectory, or 0.005.
        title: of the page.

    Returns:
        The path.

    Raises:
        ImportError: viser is not installed (the extra ``viewer``).
        ValueError: configurations of another robot, or none.
    """
    return write_page(robot, _motion(robot, trajectory, dt), Path(path), title=title)


def write_page(robot: Robot, motion: Motion, out: Path, *, title: str) -> Path:
    """Write the page of an already loaded motion."""
    server = open_server("127.0.0.1", 0, title)
    try:
        cast = Cast(server, robot, motion, panel=False)
        serializer = server.get_scene_serializer()
        count = max(int(np.ceil(motion.duration * _PICTURES)), 1)
        for now in np.linspace(0.0, motion.duration, count + 1):
            cast.show(float(now))
            serializer.insert_sleep(motion.duration / count)
        page = serializer.as_html()
    finally:
        close_server(server)
    page = page.replace("<title>Viser</title>", f"<title>{html.escape(title, quote=False)}</title>", 1)
    out.write_text(page, encoding="utf-8")
    return out


def _motion(robot: Robot, trajectory: Any, dt: float | None) -> Motion:
    """Return the checked runs with their times."""
    if isinstance(trajectory, Trajectory):
        period = float(trajectory.time[1] - trajectory.time[0]) if len(trajectory.time) > 1 else 0.005
        trajectory, dt = trajectory.q, period if dt is None else dt
    given = trajectory if isinstance(trajectory, Mapping) else {"motion": trajectory}
    runs = {str(name): np.asarray(q, float) for name, q in given.items()}
    for name, q in runs.items():
        if q.ndim != 2 or len(q) == 0 or q.shape[1] != robot.nq or not np.isfinite(q).all():
            raise OsikValueError(f"run {name!r} has shape {q.shape}; it is configurations (T, {robot.nq}), all finite")
    period = 0.005 if dt is None else float(dt)
    if not (runs and np.isfinite(period) and period > 0.0):
        raise OsikValueError(
            f"there are {len(runs)} runs and dt is {period}; it takes one at least, and a positive time"
        )
    return Motion(runs, {name: np.arange(len(q)) * period for name, q in runs.items()})
