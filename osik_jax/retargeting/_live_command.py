"""Implementation of ``osik retarget --live``: replay of a clip at its own rate, or a stream of JSON lines."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TextIO

import numpy as np

from .._errors import OsikValueError
from ..robot import Robot
from ._live import LiveFrame, LiveRetargeter
from ._motion import HumanMotion
from ._person import read_person
from ._retargeted import Retargeted, as_retargeted
from ._robot_motion import in_mujoco_order

Make = Callable[[HumanMotion], LiveRetargeter]
"""Function that makes a live retargeter for the person standing in the given frames."""


def replay(make: Make, motion: HumanMotion, *, paced: bool = True) -> tuple[Retargeted, list[LiveFrame]]:
    """Retarget a clip frame by frame, each when it is due; the person is measured from the whole clip."""
    live = make(motion)
    person = read_person(motion, live.roles)
    for _ in range(live.frames_ahead + 2):  # so that all is compiled when the first frame comes
        live.step(motion.positions[0])
    live.reset()
    found, began = [], time.perf_counter()
    for f, positions in enumerate(motion.positions):
        if paced:
            time.sleep(max(0.0, began + f / motion.fps - time.perf_counter()))
        found.append(live.step(positions, None if motion.contact is None else motion.contact[f]))
    frames = [frame for frame in found if frame is not None] + live.finish()
    contact = np.array([frame.contact for frame in frames])
    q = np.array([frame.q for frame in frames])
    person = dataclasses.replace(person, contact=contact)
    off = np.array([frame.off_plan for frame in frames])
    return as_retargeted(live.robot, live.profile, person, q, off), frames


def stream(make: Make, lines: Iterable[str], out: TextIO) -> int:
    """Read a person's frames as JSON lines and write the robot's frames as they are computed.

    The first input line is ``{"fps": 30, "joint_names": [...]}``, with ``"standing": [[x, y, z], ...]`` if the first
    frame does not show the person standing. Each other line is a frame: ``{"positions": [[x, y, z], ...]}`` in metres,
    z up, null for a joint that is not seen, optionally ``"contact": [...]``; ``null`` is a lost frame. The first output
    line has ``joint_names`` and ``latency`` [s]; each other line is ``{"frame": 0, "qpos": [...], "contact": [...],
    "status": "followed"}`` in MuJoCo's order. Return how many frames were written.
    """
    rows = _rows(lines)
    head = next(rows, (1, None))[1]
    if not isinstance(head, dict) or not {"fps", "joint_names"} <= set(head):
        raise OsikValueError("line 1 has to be an object with fps and joint_names")
    live, written = None, 0
    for number, row in rows:
        try:
            positions, contact = _frame(row)
            if live is None and positions is None:
                continue
            if live is None:
                live = make(_standing(head, positions))
                names = in_mujoco_order(live.robot, np.asarray(live.robot.q0)[None], head["fps"]).joint_names
                _write(out, {"joint_names": names, "latency": live.latency})
            frame = live.step(positions, contact)
        except (ValueError, TypeError, KeyError) as error:
            raise OsikValueError(f"line {number}: {error.args[0]}") from error
        written += _written(out, live.robot, written, [] if frame is None else [frame])
    return written if live is None else written + _written(out, live.robot, written, live.finish())


def _rows(lines: Iterable[str]) -> Iterator[tuple[int, Any]]:
    for number, line in enumerate(lines, 1):
        if line.strip():
            try:
                yield number, json.loads(line)
            except json.JSONDecodeError as error:
                raise OsikValueError(f"line {number} is no JSON: {error.msg}") from error


def _frame(row: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return positions (J, 3) and contacts (4,) of one line; None where missing."""
    if row is None:
        return None, None
    if not isinstance(row, dict) or "positions" not in row:
        raise OsikValueError("a frame is an object with positions, or null")
    contact = row.get("contact")
    return _points(row["positions"]), None if contact is None else np.array(contact, bool)


def _points(rows: Any) -> np.ndarray:
    return np.array([[math.nan] * 3 if row is None else row for row in rows], float)


def _standing(head: dict[str, Any], positions: np.ndarray | None) -> HumanMotion:
    """Return the standing pose of the person, from the first line or else from the first frame."""
    still = positions if head.get("standing") is None else _points(head["standing"])
    if still is None or not np.isfinite(still).all():
        raise OsikValueError("the first frame has joints that are not seen; give a pose of standing in the first line")
    return HumanMotion("stream", float(head["fps"]), tuple(head["joint_names"]), still[None])


def _written(out: TextIO, robot: Robot, first: int, frames: Sequence[LiveFrame]) -> int:
    """Write frames as JSON lines numbered from ``first``; return their number."""
    for number, frame in enumerate(frames, first):
        qpos = in_mujoco_order(robot, frame.q[None], 1.0).qpos[0]
        row = {"frame": number, "qpos": qpos.tolist(), "contact": frame.contact.tolist()}
        _write(out, {**row, "status": frame.status.name.lower()})
    return len(frames)


def _write(out: TextIO, row: dict[str, Any]) -> None:
    print(json.dumps(row), file=out, flush=True)
