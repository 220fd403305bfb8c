"""Inverse kinematics of an arm for very many poses in one call, on the default device; judged by MuJoCo.

    python -m benchmarks.ik.many [results.json] [--robot panda] [--poses 100000] [--calls 3] [--precision float32]

The poses are those of configurations that are uniform within the limits. A pose counts as found where MuJoCo, in double
precision, says that it is within 1 mm and 0.01 rad. The time is of the whole call, from the host's arrays to results on
the device, compiling left out; the rate is that of the shortest call.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from ..descriptions import ROBOTS
from ..machine import processor
from ..throughput import loaded
from .humanoids import ORIENTATION, POSITION, Judge, errors

_ARMS = tuple(name for name, given in ROBOTS.items() if not given.feet)


def measured(name: str, count: int, calls: int) -> dict[str, Any]:
    """One arm."""
    robot, frame = loaded(name), ROBOTS[name].hand
    judge, rng = Judge(robot), np.random.default_rng(0)
    lower, upper = (np.asarray(end, float) for end in (robot.position_lower, robot.position_upper))
    goals = [{frame: judge.pose(frame)} for _ in judge.along(lower + (upper - lower) * rng.random((count, robot.nq)))]
    target = tuple(np.stack([goal[frame][part] for goal in goals]).astype(robot.q0.dtype) for part in (0, 1))

    def find() -> tuple[osik.InverseKinematicsSolution, float]:
        start = time.perf_counter()
        found = osik.inverse_kinematics(
            robot, {frame: target}, position_tolerance=POSITION, orientation_tolerance=ORIENTATION
        )
        jax.block_until_ready(found)
        return found, time.perf_counter() - start

    found, first = find()
    seconds = np.sort([find()[1] for _ in range(calls)])
    called = np.asarray(found.converged)
    judged = [errors(judge, goal, ()) for goal, _ in zip(goals, judge.along(np.asarray(found.q)), strict=True)]
    away, turned = np.array(judged).T
    good = (away <= POSITION) & (turned <= ORIENTATION)
    low, high = (np.asarray(end, found.q.dtype) for end in (robot.position_lower, robot.position_upper))
    return {
        "poses": count,
        "found": float(good.mean()),
        "wrongly called found": int((called & ~good).sum()),
        "limits broken": int(((np.asarray(found.q) < low) | (np.asarray(found.q) > high)).any(1).sum()),
        "median position error [m]": float(np.median(away)),
        "first call [s]": first,
        "shortest call [ms]": 1e3 * float(seconds[0]),
        "median call [ms]": 1e3 * float(np.median(seconds)),
        "poses a second": count / float(seconds[0]),
        "load average": os.getloadavg()[0],
    }


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ik.many", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", type=Path, nargs="?")
    parser.add_argument("--robot", choices=_ARMS, default="panda")
    parser.add_argument("--poses", type=int, default=100000)
    parser.add_argument("--calls", type=int, default=3)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    setting = {"precision": given.precision, "device": jax.devices()[0].device_kind, "processor": processor()}
    results = {"robot": given.robot, **measured(given.robot, given.poses, given.calls), "setting": setting}
    print(json.dumps(results, indent=1))
    if given.results is not None:
        given.results.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    configure_cpu()
    main()
