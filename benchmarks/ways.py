"""Ways around obstacles on recorded problems: dense states of each for a judge, and the time of each call.

    python -m benchmarks.ways ROBOT WAYS.npz [--problems FILE.npz] [--sets box cage] [--count 10] [--batch]
                              [--clearance 0.005] [--key 0] [--dense 0.001]

ROBOT and FILE.npz are those of ``benchmarks.collision_free``; FILE.npz also has a ``start`` for each problem. WAYS.npz
gets ``set`` and ``index`` of each problem, ``found``, ``seconds`` of the call from Python, ``duration`` of the motion
under the limits of speed and 5 rad/s^2 [s], and ``q``, states of all ways one after another in the order of the file's
joints, ``states`` of each, so near that no joint moves a point 1 m away by more than ``--dense`` [m]. Joints whose
start or goal is out of range have their range widened to it.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from benchmarks.collision_free import Problem, Setting, arguments, read, setting
from osik_jax.motion import Way, connect


def main() -> None:
    """Connect the starts and goals that the command line names."""
    parser = arguments(__doc__, "ways")
    parser.add_argument("--dense", type=float, default=1e-3)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    osik.runtime.configure_cpu()
    path = given.problems or Path(os.environ.get("OSIK_PROBLEMS", ".")) / f"{given.robot}.npz"
    head, problems = read(path)
    starts, chosen, counts = np.load(path)["start"], [], {}
    for problem, start in zip(problems, starts, strict=True):
        counts[problem.set] = counts.get(problem.set, 0) + 1
        if (not given.sets or problem.set in given.sets) and counts[problem.set] <= (given.count or len(starts)):
            chosen.append((problem, start))
    own = setting(given.robot, head)
    ends = np.array([[start, problem.goal] for problem, start in chosen])
    own = own._replace(robot=widened(own, ends))
    ways, seconds = connected(own, [problem for problem, _ in chosen], ends, given)
    states = [dense(way, given.dense)[:, own.entries] for way in ways]
    found = np.array([way.found for way in ways])
    np.savez(
        given.ways,
        set=np.array([problem.set for problem, _ in chosen]),
        index=np.array([problem.index for problem, _ in chosen]),
        found=found,
        seconds=seconds,
        duration=np.array([float(way.retime(acceleration=5.0).duration) if way.found else np.nan for way in ways]),
        q=np.concatenate(states),
        states=np.array(list(map(len, states))),
    )
    for name in counts:
        which = np.array([problem.set == name for problem, _ in chosen])
        if which.any():
            print(f"{name}: {text([way for way, own in zip(ways, which, strict=True) if own], seconds[which])}")
    print(f"all: {text(ways, seconds)}")


def text(ways: list[Way], seconds: np.ndarray) -> str:
    """Return the row of a table."""
    ms, found = 1e3 * seconds, sum(way.found for way in ways)
    closed = sum("the clearance" in way.problem for way in ways)
    return (
        f"{len(ways)} problems, {closed} whose start or goal touches, found {found}; "
        f"a call: median {np.median(ms):.1f} ms, 95 % {np.quantile(ms, 0.95):.1f} ms, longest {ms.max():.0f} ms"
    )


def widened(own: Setting, ends: np.ndarray) -> osik.Robot:
    """Return the robot with ranges of joints that hold all starts and goals (n, 2, joints)."""
    lower, upper = np.array(own.robot.position_lower), np.array(own.robot.position_upper)
    lower[own.entries] = np.minimum(lower[own.entries], ends.min(axis=(0, 1)))
    upper[own.entries] = np.maximum(upper[own.entries], ends.max(axis=(0, 1)))
    return own.robot.replace(position_lower=lower, position_upper=upper)


def connected(own: Setting, problems: list[Problem], ends: np.ndarray, given: Any) -> tuple[list[Way], np.ndarray]:
    """Return the ways, and seconds of each call, after a first one that compiles."""
    q = np.tile(np.asarray(own.robot.q0, float), (len(ends), 2, 1))
    q[:, :, own.entries] = ends
    options = {"srdf": own.srdf, "clearance": given.clearance, "key": given.key}

    def timed(q_from: np.ndarray, q_to: np.ndarray, scene: osik.Scene) -> tuple[Any, float]:
        start = time.perf_counter()
        way = connect(own.robot, q_from, q_to, scene, **options)
        return way, time.perf_counter() - start

    if given.batch:
        scenes = osik.Scene.stack([problem.scene for problem in problems])
        first, (ways, seconds) = timed(q[:, 0], q[:, 1], scenes)[1], timed(q[:, 0], q[:, 1], scenes)
        print(f"{len(ways)} problems in one call: {seconds:.3f} s; first call {first:.2f} s")
        return ways, np.full(len(ways), seconds / len(ways))
    print(f"first call {timed(q[0, 0], q[0, 1], problems[0].scene)[1]:.2f} s")
    ways, seconds = zip(*(timed(two[0], two[1], p.scene) for two, p in zip(q, problems, strict=True)), strict=True)
    return list(ways), np.array(seconds)


def dense(way: Way, step: float) -> np.ndarray:
    """Return states of the path, the end included."""
    if way.path is None:
        return np.asarray(way.vertices)
    legs = np.abs(np.diff(way.vertices, axis=0)).sum()
    count = max(256, 1 << int(np.ceil(np.log2(legs / step + 1))))  # few lengths are compiled
    return np.asarray(_states(way.path, jnp.linspace(0.0, 1.0, count)))


@jax.jit
def _states(path: Any, at: jax.Array) -> jax.Array:
    return path.derivatives(at)[0]


if __name__ == "__main__":
    main()
