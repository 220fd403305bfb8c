"""Timed motions: limits, starts, times and poses that cannot be."""

# pyright: reportArgumentType=false
from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax.motion import Motion, PoseFilter, Stream, chunk, connect, film_motion, follow, move, retime

from ._given import FAR, Add, K, T, V, arm, nao
from ._problems import ur5

LIMITS: dict[str, Any] = {"velocity": 1.5, "acceleration": 4.0, "jerk": 40.0}
TIMES = np.linspace(0.0, 1.0, 5)


def _line(to: float = 0.5, of: int = 0) -> np.ndarray:
    return np.asarray(arm().q0) + np.linspace(0.0, to, 5)[:, None] * np.eye(7)[of]


def _retime(**more: Any) -> Any:
    return retime(**({"waypoints": _line(), "robot": arm()} | LIMITS | more))


def _chunk(**more: Any) -> Any:
    return chunk(**({"robot": arm(), "waypoints": _line(), "times": TIMES} | LIMITS | more))


def _stream(**more: Any) -> Stream:
    return Stream(**({"robot": arm(), "q": arm().q0, "latency": 0.1, "waypoints": 9} | LIMITS | more))


def _move(**more: Any) -> Any:
    return move(**({"robot": arm(), "start": arm().q0, "goal": arm().q0} | LIMITS | more))


def _connect(**more: Any) -> Any:
    scene = osik.Scene({"can": osik.CollisionShape.sphere(0.1, [0.3, 0.5, 0.2])})
    return connect(**({"robot": ur5(), "q_from": ur5().q0, "q_to": ur5().q0, "scene": scene} | more))


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
    add("a chunk with a smoothing of 0", lambda: _chunk(smoothing=0.0), V, "have to be positive")
    add("a motion at one time that is no array", lambda: _retime().at(0.1), V, "as [0.1] for one")
    add("a motion's samples every 'a' seconds", lambda: _retime().sample("a"), T, "dt is 'a'")
    add("a move from a start that is too fast", lambda: _move(start=(home, fast, rest)), V, "whose limit is")
    add("a move to a goal outside of its range", lambda: _move(goal=home - 9.0), V, "goal has the position")
    add("a move with a limit of 0", lambda: _move(velocity={"joint2": 0.0}), V, "joint2 0")
    add("a chunk for a robot that stands on a free base", lambda: _chunk(robot=nao()), V, "floating_base; lock them")
    add("a stream with a latency of 0", lambda: _stream(latency=0.0), V, "latency is 0")
    add("a chunk of 5 waypoints in a stream of 9", lambda: _stream().push(_line(), TIMES, 0.0), V, "takes 9 waypoints")
    two = [jnp.zeros((2, 2))] * 3
    add(
        "a film of two joints with a robot of seven",
        lambda: film_motion(Motion(jnp.arange(2.0), *two), arm(), "film.gif"),
        V,
        "2 joints",
    )
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
    add("a way from 5 numbers for 6 joints", lambda: _connect(q_from=np.zeros(5)), V, "have 6 entries")
    add("a way to a goal with a NaN", lambda: _connect(q_to=np.full(6, np.nan)), V, "q_to is not finite")
    add("a way that a held joint prevents", lambda: _connect(q_to=np.ones(6), joints=["wrist*"]), V, "elbow_joint")
    add("a way with joints that do not exist", lambda: _connect(joints=["elbw_joint"]), K, "elbow_joint")
    add("a way that keeps -1 m", lambda: _connect(clearance=-1.0), V, "clearance is -1")
    add("a way by no configuration", lambda: _connect(states=0), V, "states is 0")
    add("a way in a dictionary of shapes", lambda: _connect(scene={}), T, "make an osik_jax.Scene")
