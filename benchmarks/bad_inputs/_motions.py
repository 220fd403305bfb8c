"""Timed motions: limits, starts, times and poses that cannot be."""

# pyright: reportArgumentType=false
from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from osik_jax.motion import PoseFilter, chunk, follow, move, retime

from ._given import FAR, Add, K, T, V, arm

LIMITS: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
TIMES = np.linspace(0.0, 1.0, 5)


def _line(to: float = 0.5, of: int = 0) -> np.ndarray:
    return np.asarray(arm().q0) + np.linspace(0.0, to, 5)[:, None] * np.eye(7)[of]


def _retime(**more: Any) -> Any:
    return retime(**({"waypoints": _line(), "robot": arm()} | LIMITS | more))


def _chunk(**more: Any) -> Any:
    return chunk(**({"robot": arm(), "waypoints": _line(), "times": TIMES} | LIMITS | more))


def _move(**more: Any) -> Any:
    return move(**({"robot": arm(), "start": arm().q0, "goal": arm().q0} | LIMITS | more))


def motions(add: Add) -> None:
    home, rest = np.asarray(arm().q0), np.zeros(7)
    fast = rest + 2.0 * np.eye(7)[3]
    add("a limit of acceleration of 0", lambda: _retime(acceleration=0.0), V, "positive")
    add("a limit of jerk of -1", lambda: _retime(jerk=-1.0), V, "positive")
    add("no limit of acceleration", lambda: retime(_line(), velocity=1.0), V, "no least time")
    add("limits of a joint that does not exist", lambda: _retime(velocity={"elbow": 1.0}), K, "joint1")
    add("waypoints outside of a range", lambda: _retime(waypoints=_line(9.0)), V, "waypoint 2")
    add("a waypoint twice in a row", lambda: _retime(waypoints=_line()[[0, 1, 1, 2]]), V, "1 and 2 are equal")
    add("one waypoint", lambda: _retime(waypoints=_line()[:1]), V, "two or more")
    add("a wanted speed without a frame", lambda: _retime(speed=0.1), T, "frame=")
    add("times that go backwards", lambda: _chunk(times=TIMES[::-1]), V, "time 1")
    add("a chunk that begins after its end", lambda: _chunk(begin=2.0), V, "begin is 2")
    add("a chunk from a start that is too fast", lambda: _chunk(start=(home, fast, rest)), V, "whose limit is")
    add("a chunk from a start outside of its range", lambda: _chunk(start=(home + 9.0, rest, rest)), V, "joint1")
    add("a move from a start that is too fast", lambda: _move(start=(home, fast, rest)), V, "whose limit is")
    add("a move to a goal outside of its range", lambda: _move(goal=home - 9.0), V, "goal has the position")
    add("a move with a limit of 0", lambda: _move(velocity={"joint2": 0.0}), V, "joint2 0")
    far = np.linspace(0.0, 2.0, 4)[:, None] * np.eye(3)[0] + FAR[0]
    add(
        "a path that leaves reach",
        lambda: follow(arm(), {"hand": far}, acceleration=4.0),
        V,
        "Pose 1: not found",
        foreign=True,
    )
    add("a path of one pose", lambda: follow(arm(), {"hand": far[:1]}, acceleration=4.0), V, "two or more")
    add("a filter that is updated after 0 s", lambda: PoseFilter(FAR).update(FAR, 0.0), V, "dt is 0")
    add("a filter with a time constant of 0", lambda: PoseFilter(FAR, time_constant=jnp.zeros(())), V, "positive")
