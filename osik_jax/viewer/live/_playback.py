"""Motions, their files, and pages that play them without a server: one robot per run, side by side."""

from __future__ import annotations

import dataclasses
import html
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..._errors import OsikValueError
from ..._npz import open_npz
from ..._whole_file import write_text
from ...control import Trajectory
from ...robot import Robot
from ...robot._mujoco import mujoco_poses
from .._parts import floor_height, robot_parts
from ._robot_nodes import RobotNodes, add_label, add_surroundings, side_by_side
from ._server import close_server, open_server
from ._stick_figure import StickFigure, StickNodes

_PICTURES = 30.0
"""Number of pictures kept per second."""
_RATE = 200.0
"""Sample rate of an array without times [Hz]."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """Motion of one or more runs, with their times.

    Attributes:
        runs: name to configurations. {name: (T, nq)}
        times: name to the time of each configuration [s]. {name: (T,)}
        person: the person whose motion the first run is, at its times; None: nobody's.
    """

    runs: Mapping[str, Float[np.ndarray, "T nq"]]
    times: Mapping[str, Float[np.ndarray, " T"]]
    person: StickFigure | None = None

    @property
    def duration(self) -> float:
        """Return the duration of the longest run [s]."""
        return max(float(time[-1]) for time in self.times.values())

    def at(self, name: str, now: float) -> Float[np.ndarray, " nq"]:
        """Return the configuration of a run at a time [s]; its last one after the end."""
        return self.runs[name][self.frame(name, now)]

    def frame(self, name: str, now: float) -> int:
        """Return the index of a run's configuration at a time [s]."""
        return max(int(np.searchsorted(self.times[name], now, side="right")) - 1, 0)


def read_motion(path: str | os.PathLike[str], robot: Robot) -> Motion:
    """Read a motion from ``osik demo``, ``osik retarget``, or ``numpy.savez(path, q=rollout.q, time=...)``.

    Runs are arrays (T, nq) called ``q`` or ``q_NAME``; times are ``time_NAME`` or ``time``, one fewer where they are
    those of the steps; without any, there are 200 configurations a second. What ``osik retarget`` writes is ``qpos``
    with ``joint_names`` and ``fps``; its person is shown too.
    """
    try:
        with open_npz(path) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise FileNotFoundError(f"no such file: {path}") from None
    except Exception as error:
        raise OsikValueError(f"{path} is no motion: it is not a .npz file of numpy") from error
    person = None
    if {"qpos", "joint_names", "fps"} <= arrays.keys():
        person = StickFigure.of(arrays)
        arrays = _retargeted(arrays, robot, path)
    runs = {n.removeprefix("q").lstrip("_") or "motion": a for n, a in arrays.items() if n == "q" or n[:2] == "q_"}
    if not runs:
        raise OsikValueError(f"{path} is no motion: it has no array q or q_NAME, only {', '.join(arrays) or 'nothing'}")
    for name, q in runs.items():
        if q.ndim != 2 or len(q) == 0 or q.shape[1] != robot.nq or not np.isfinite(q).all():
            raise OsikValueError(
                f"{path}: run {name!r} has shape {q.shape}, and the robot's configurations have {robot.nq} finite "
                "numbers: is it the motion of another robot? Say which with --robot"
            )
    return Motion(runs, {name: _times(name, len(q), arrays) for name, q in runs.items()}, person)


def _retargeted(arrays: Mapping[str, np.ndarray], robot: Robot, path: Any) -> dict[str, np.ndarray]:
    """Return the arrays q and time of a motion whose joints are given by name."""
    qpos, names = np.asarray(arrays["qpos"], float), [str(name) for name in arrays["joint_names"]]
    tree = robot.tree
    unknown, base = sorted(set(names) - set(tree.joint_names)), 7 * robot.floating_base
    if unknown or qpos.ndim != 2 or qpos.shape[1] != base + len(names):
        what = f"it has no joint {unknown[0]}" if unknown else "its base moves otherwise, or the columns are others"
        raise OsikValueError(f"{path} is the motion of another robot ({what}): say which with --robot and --base")
    q = np.tile(np.asarray(robot.q0, float), (len(qpos), 1))
    if base:
        free = tree.qpos_address[tree.free_bases[0]]
        q[:, free : free + 7] = qpos[:, :7]
    for column, name in enumerate(names, base):
        joint = tree.joint_names.index(name)
        if joint in tree.independent:
            q[:, tree.qpos_address[joint]] = qpos[:, column]
    return {"q": q, "time": np.arange(len(q)) / float(arrays["fps"])}


def _times(name: str, count: int, arrays: Mapping[str, np.ndarray]) -> Float[np.ndarray, " T"]:
    """Return the time of each configuration of a run, starting at 0 [s]."""
    time = arrays.get(f"time_{name}", arrays.get("time"))
    if time is None or time.ndim != 1 or len(time) not in (count, count - 1) or len(time) < 2:
        return np.arange(count) / _RATE
    time = np.asarray(time, float)
    if len(time) == count - 1:
        time = np.append(time, 2.0 * time[-1] - time[-2])
    return time - time[0]


class Cast:
    """Robots of a motion, side by side in one scene, and on their left the person, as large as a robot."""

    def __init__(self, server: Any, robot: Robot, motion: Motion) -> None:
        """Add a robot per run, the floor and a camera."""
        shapes, self._robot, self._motion = robot_parts(robot), robot, motion
        spans = np.concatenate([_span(robot, shapes, q) for q in motion.runs.values()])
        first = next(iter(motion.runs.values()))
        floor = floor_height(robot, shapes, mujoco_poses(robot, first[:1]))
        person, self._person = motion.person, None
        if person is not None:
            base = [robot.tree.qpos_address[b] + k for b in robot.tree.free_bases for k in range(3)]
            person = person.sized(_span(robot, shapes, first[:1]), first[:, base] if base else np.zeros((1, 3)), floor)
            spans = np.concatenate([spans, person.points.reshape(-1, 3)])
        offsets = side_by_side(spans, len(motion.runs) + (person is not None))
        seen = np.concatenate([spans + offset for offset in offsets])
        add_surroundings(server, seen, floor, panel=False)
        if person is not None:
            self._person = StickNodes(server.scene, person, offsets[0])
            add_label(server.scene, "person", person.points.reshape(-1, 3) + offsets.pop(0))
        self._nodes: dict[str, RobotNodes] = {}
        for name, offset in zip(motion.runs, offsets, strict=True):
            self._nodes[name] = RobotNodes(server.scene, robot, name=f"robot {name}", offset=offset)
            if len(motion.runs) > 1:
                add_label(server.scene, name, spans + offset)

    def show(self, now: float) -> None:
        """Move all robots to a time [s]."""
        for name, nodes in self._nodes.items():
            nodes.place(next(mujoco_poses(self._robot, self._motion.at(name, now))))
        if self._person is not None:
            self._person.place(self._motion.frame(next(iter(self._nodes)), now))


def _span(robot: Robot, shapes: Any, q: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, "points 3"]:
    """Return corners of the robot's bounding boxes at a few instants [m]."""
    chosen = q[np.unique(np.linspace(0, len(q) - 1, 9).astype(int))]
    return np.concatenate([shapes.corners(data) for data in mujoco_poses(robot, chosen)])


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
        cast = Cast(server, robot, motion)
        serializer = server.get_scene_serializer()
        count = max(int(np.ceil(motion.duration * _PICTURES)), 1)
        for now in np.linspace(0.0, motion.duration, count + 1):
            cast.show(float(now))
            serializer.insert_sleep(motion.duration / count)
        page = serializer.as_html()
    finally:
        close_server(server)
    page = page.replace("<title>Viser</title>", f"<title>{html.escape(title, quote=False)}</title>", 1)
    write_text(out, page)
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
