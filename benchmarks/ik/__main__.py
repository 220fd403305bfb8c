"""Inverse kinematics of arms, beside mink, pink and TRAC-IK, judged by Pinocchio.

    python -m benchmarks.ik [results.json] [--robots panda ur5 xarm7 kinova] [--poses 10000] [--peer-poses 100]
                            [--precision float32] [--python pytracik=PATH]

Sets of poses: of random configurations; of configurations with joints at limits and at 0; farther away than the links
are long; and, for a UR5, nearer to the first axis than its last joint can come. A pose counts as found where Pinocchio,
in double precision, says that it is within 1 mm and 0.01 rad. The peers get up to 8 starts of 100 steps each, without
limits on speeds, on the first poses of each set. With the interpreter of an environment that has pytracik, TRAC-IK gets
50 ms for each. Times are of the whole call, compiling left out.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from osik_jax.runtime import configure_cpu

from ..machine import processor
from ..processes import PeerUnavailable
from ._arms import ABOUT_THE_BASE, ARMS, Arm, Poses
from ._solvers import ORIENTATION, POSITION, Answer, ours, ours_one_by_one, with_mink, with_pink, with_pytracik

ONE_BY_ONE = 200
_PACKAGES = ("jax", "jaxlib", "mink", "pin-pink", "pin", "numpy")


def judged(arm: Arm, poses: Poses, answer: Answer) -> dict[str, Any]:
    """What an answer is worth."""
    q, called_found, seconds = answer
    away, turned = arm.errors(q, poses)
    found = (away <= POSITION) & (turned <= ORIENTATION)
    broken = (q < arm.lower) | (q > arm.upper)
    return {
        "poses": len(q),
        "found": float(found.mean()),
        "called found": float(called_found.mean()),
        "wrongly called found": int((called_found & ~found).sum()),
        "limits broken": int(broken.any(1).sum()),
        "largest passage of a limit [rad]": float(np.maximum(arm.lower - q, q - arm.upper).max(initial=0.0)),
        "median position error [m]": float(np.median(away)),
        "median orientation error [rad]": float(np.median(turned)),
        "poses a second": len(q) / seconds,
    }


def measured(name: str, poses: int, peer_poses: int, tracik: Tracik | None) -> dict[str, Any]:
    """All solvers on all sets of a robot."""
    arm, rng = Arm(name), np.random.default_rng(0)
    sets = {
        "reachable": arm.reachable(poses, rng),
        "at the edge": arm.at_the_edge(poses // 10, rng),
        "out of reach": arm.out_of_reach(poses // 10, rng),
    }
    if name in ABOUT_THE_BASE:
        sets["too near the base"] = arm.too_near(poses // 10, rng)
    results: dict[str, Any] = {}
    for kind, given in sets.items():
        few = Poses(given.positions[:peer_poses], given.rotations[:peer_poses])
        some = Poses(given.positions[:ONE_BY_ONE], given.rotations[:ONE_BY_ONE])
        results[kind] = {"osik, in one call": judged(arm, given, ours(arm, given))}
        if kind == "reachable":
            results[kind]["osik, one by one"] = judged(arm, some, ours_one_by_one(arm, some))
        if peer_poses:
            results[kind]["mink"] = judged(arm, few, with_mink(arm, few))
            results[kind]["pink"] = judged(arm, few, with_pink(arm, few))
            if tracik is not None and (answer := tracik(arm, few)) is not None:
                results[kind]["pytracik"] = judged(arm, few, answer)
    return results


class Tracik:
    """TRAC-IK in an environment of its own; where it does not start, that is told once and it is left out.

    Attributes:
        version: of pytracik, once it has answered.
    """

    def __init__(self, python: str) -> None:
        self._python: str | None = python
        self.version = "unknown"

    def __call__(self, arm: Arm, poses: Poses) -> Answer | None:
        """Its answer."""
        if self._python is None:
            return None
        try:
            answer, self.version = with_pytracik(arm, poses, self._python)
        except PeerUnavailable as reason:
            print(f"pytracik is left out: {reason}", file=sys.stderr)
            self._python = None
            return None
        return answer


def table(results: dict[str, Any]) -> Table:
    """The results, for reading."""
    shown = Table(
        "robot", "poses", "solver", "n", "found", "wrongly called found", "limits broken", "error [m]", "poses/s"
    )
    for robot, sets in results.items():
        for kind, solvers in sets.items():
            for solver, row in solvers.items():
                shown.add_row(
                    robot,
                    kind,
                    solver,
                    str(row["poses"]),
                    f"{100.0 * row['found']:.2f} %",
                    str(row["wrongly called found"]),
                    str(row["limits broken"]),
                    f"{row['median position error [m]']:.1e}",
                    f"{row['poses a second']:,.0f}",
                )
    return shown


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ik", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", type=Path, nargs="?")
    parser.add_argument("--robots", nargs="+", choices=sorted(ARMS), default=list(ARMS))
    parser.add_argument("--poses", type=int, default=10000)
    parser.add_argument("--peer-poses", type=int, default=100)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    parser.add_argument("--python", metavar="pytracik=PATH", help="interpreter of an environment that has pytracik")
    given = parser.parse_args()
    if given.python is not None and not given.python.startswith("pytracik="):
        parser.error(f"--python takes pytracik=PATH; got {given.python}")
    tracik = None if given.python is None else Tracik(given.python.removeprefix("pytracik="))
    jax.config.update("jax_enable_x64", given.precision == "float64")
    load = os.getloadavg()[0]
    results = {name: measured(name, given.poses, given.peer_poses, tracik) for name in given.robots}
    Console(width=160).print(table(results))
    if given.results is not None:
        setting = {
            "precision": given.precision,
            "device": jax.devices()[0].device_kind,
            "processor": processor(),
            "cores": os.cpu_count(),
            "load average before": load,
            "versions": {package: version(package) for package in _PACKAGES}
            | ({} if tracik is None else {"pytracik": tracik.version}),
        }
        given.results.write_text(json.dumps({"setting": setting, "results": results}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    configure_cpu()
    main()
