"""Plays motions: a slider for the time, a speed, and one robot for each run side by side."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from ...robot import Robot
from .._look import Look
from .._mujoco import mujoco_poses
from .._outline import floor_height
from .._parts import robot_parts
from ._robot_nodes import RobotNodes
from ._server import close_server, open_server
from ._surroundings import add_surroundings

_FRAME = 1.0 / 30.0
"""Time between pictures [s]."""
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_APART = 1.1
"""Robots stand so many of their widths apart."""
_RATE = 200.0
"""Of an array without times [Hz]."""


class Motion:
    """Runs of one motion.

    Attributes:
        runs: name to configurations. {name: (T, nq)}
        times: name to the time of each configuration [s]. {name: (T,)}
    """

    def __init__(self, runs: Mapping[str, Float[np.ndarray, "T nq"]], times: Mapping[str, np.ndarray]) -> None:
        """Takes runs with their times."""
        self.runs, self.times = dict(runs), dict(times)

    @property
    def duration(self) -> float:
        """Of the longest run [s]."""
        return max(float(time[-1]) for time in self.times.values())

    def at(self, name: str, now: float) -> Float[np.ndarray, " nq"]:
        """The configuration of a run at a time, or its last one [s]."""
        return self.runs[name][max(int(np.searchsorted(self.times[name], now, side="right")) - 1, 0)]


def read_motion(path: str | os.PathLike[str], robot: Robot) -> Motion:
    """Reads a motion that ``osik demo``, a live view or ``numpy.savez(path, q=rollout.q, time=...)`` wrote.

    Runs are arrays (T, nq) called ``q`` or ``q_NAME``; times are ``time_NAME`` or ``time``, one fewer where they are
    those of the steps; without any, there are 200 configurations a second.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no motion, or one of another robot.
    """
    try:
        with np.load(Path(path), allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise FileNotFoundError(f"no such file: {path}") from None
    except Exception as error:
        raise ValueError(f"{path} is no motion: it is not a .npz file of numpy") from error
    runs = {n.removeprefix("q").lstrip("_") or "motion": a for n, a in arrays.items() if n == "q" or n[:2] == "q_"}
    if not runs:
        raise ValueError(f"{path} is no motion: it has no array q or q_NAME, only {', '.join(arrays) or 'nothing'}")
    for name, q in runs.items():
        if q.ndim != 2 or len(q) == 0 or q.shape[1] != robot.nq or not np.isfinite(q).all():
            raise ValueError(
                f"{path}: run {name!r} has shape {q.shape}, and the robot's configurations have {robot.nq} finite "
                "numbers: is it the motion of another robot? Say which with --robot"
            )
    return Motion(runs, {name: _times(name, len(q), arrays) for name, q in runs.items()})


def _times(name: str, count: int, arrays: Mapping[str, np.ndarray]) -> Float[np.ndarray, " T"]:
    """Of each configuration of a run, from 0 [s]."""
    time = arrays.get(f"time_{name}", arrays.get("time"))
    if time is None or time.ndim != 1 or len(time) not in (count, count - 1) or len(time) < 2:
        return np.arange(count) / _RATE
    time = np.asarray(time, float)
    if len(time) == count - 1:
        time = np.append(time, 2.0 * time[-1] - time[-2])
    return time - time[0]


class Cast:
    """The robots of a motion, side by side in one scene."""

    def __init__(self, server: Any, robot: Robot, motion: Motion, look: Look | None, *, panel: bool) -> None:
        """Adds a robot for each run, with the floor and a camera that leaves room for a panel or not."""
        shapes, self._robot, self._motion = robot_parts(robot, look=look), robot, motion
        spans = np.concatenate([_span(robot, shapes, q) for q in motion.runs.values()])
        width = _APART * float(np.ptp(spans[:, 1]))
        shifts = [(0.5 * (len(motion.runs) - 1) - k) * width for k in range(len(motion.runs))]
        seen = np.concatenate([spans + np.array([0.0, shift, 0.0]) for shift in shifts])
        first = next(iter(motion.runs.values()))
        add_surroundings(server, seen, floor_height(robot, shapes, mujoco_poses(robot, first[:1])), panel=panel)
        self._nodes: dict[str, RobotNodes] = {}
        for (name, _), shift in zip(motion.runs.items(), shifts, strict=True):
            offset = np.array([0.0, shift, 0.0])
            self._nodes[name] = RobotNodes(server.scene, robot, look=look, name=f"robot {name}", offset=offset)
            if len(motion.runs) > 1:
                at = spans[:, :2].mean(0) + np.array([0.0, shift])
                height = spans[:, 2].max() + 0.05 * width
                server.scene.add_label(f"/label {name}", name.replace("_", " "), position=(at[0], at[1], height))

    def show(self, now: float) -> None:
        """Moves all robots to a time [s]."""
        for name, nodes in self._nodes.items():
            nodes.place(next(mujoco_poses(self._robot, self._motion.at(name, now))))


def _span(robot: Robot, shapes: Any, q: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, "points 3"]:
    """Corners of boxes about the robot at a few instants."""
    chosen = q[np.unique(np.linspace(0, len(q) - 1, 9).astype(int))]
    return np.concatenate([shapes.corners(data) for data in mujoco_poses(robot, chosen)])


class Player:
    """A page that plays a motion, over and over.

    Attributes:
        url: address of the page.
    """

    def __init__(self, robot: Robot, motion: Motion, *, look: Look | None, host: str, port: int, title: str) -> None:
        """Starts the server and plays."""
        self._server = open_server(host, port, title)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._cast, self._motion = Cast(self._server, robot, motion, look, panel=True), motion
        gui, length = self._server.gui, motion.duration
        self._time = gui.add_slider("Time [s]", 0.0, max(length, 1e-3), step=1e-3, initial_value=0.0)
        self._speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
        self._play = gui.add_checkbox("Play", initial_value=True)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="osik-player", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Blocks until ``stop`` is called from elsewhere, or Ctrl-C."""
        while not self._end.wait(0.5):
            pass

    def stop(self) -> None:
        """Ends the player and the server."""
        self._end.set()
        self._thread.join(timeout=2.0)
        close_server(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        before = time.perf_counter()
        while not self._end.wait(_FRAME):
            now = time.perf_counter()
            if self._play.value:
                ahead = self._time.value + (now - before) * float(self._speed.value)
                self._time.value = round(ahead, 3) if ahead <= self._motion.duration else 0.0
            before = now
            with self._server.atomic():
                self._cast.show(float(self._time.value))
