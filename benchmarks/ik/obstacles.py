"""Inverse kinematics of a Panda between a table and a wall, judged by MuJoCo.

    python -m benchmarks.ik.obstacles [results.json] [--robots panda ur5] [--poses 1000] [--precision float32]

Links are capsules from joint to joint. Poses are those of random configurations that keep clear of table, wall and
themselves, so each can be reached. One counts as found where Pinocchio says that it is within 1 mm and 0.01 rad and
MuJoCo that nothing overlaps. Beside the search as it comes stands one of 1,000 searches for each pose. Times are of the
whole call, compiling left out.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from ..machine import processor
from ._arms import Arm, Poses
from ._solvers import ORIENTATION, POSITION, bodies_for_mujoco

RADIUS = 0.055
"""Of the links' capsules [m]."""
CLEARANCE = 0.005
"""That the search keeps [m]; poses are made with twice as much."""
SEARCHES = 1000
"""For each pose, of the thorough search."""
_SHORT = 0.02
"""Between joints [m]: nearer ones have a sphere around them."""


class Slab(NamedTuple):
    """A box of the world.

    Attributes:
        center: [m].
        size: half the lengths of its edges [m].
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]


WORLD = {
    "table": Slab((0.55, 0.0, 0.05), (0.3, 0.6, 0.05)),
    "wall": Slab((0.0, 0.55, 0.6), (1.0, 0.05, 0.6)),
}


class Room:
    """An arm with capsules around its links, between table and wall.

    Attributes:
        arm: by Pinocchio.
        robot: ours, without geoms.
        limits: what the search has to keep.
    """

    def __init__(self, name: str) -> None:
        self.arm = Arm(name)
        self.robot = osik.Robot.from_urdf(self.arm.urdf, floating_base=False)
        shapes = {f"{link} capsule": _shape(link, end) for link, end in self.links().items()}
        world = {what: osik.CollisionShape.box(slab.size, slab.center) for what, slab in WORLD.items()}
        avoid = osik.CollisionAvoidanceLimit(
            self.robot, shapes={**shapes, **world}, minimum_distance=CLEARANCE, q0_distance=CLEARANCE, max_pairs=12
        )
        self.limits = (osik.ConfigurationLimit(self.robot), avoid)
        self.judge = Judge(self.arm, self.links(), avoid.pairs)

    def links(self) -> dict[str, np.ndarray]:
        """By name the links that move, with the place of what comes next in their axes [m]."""
        model = self.arm.model
        ends: dict[str, np.ndarray] = {}
        for joint in range(1, model.njoints):
            link = next(f.name for f in model.frames if f.parentJoint == joint and f.name in _links(self.arm.urdf))
            after = [model.jointPlacements[k].translation for k in range(1, model.njoints) if model.parents[k] == joint]
            tip = model.frames[model.getFrameId(self.arm.frame)].placement.translation
            ends[link] = np.array(after[0] if after else tip)
        return ends

    def poses(self, count: int, rng: np.random.Generator) -> Poses:
        """Of random configurations that are clear."""
        clear = []
        while len(clear) < count:
            q = self.arm.lower + (self.arm.upper - self.arm.lower) * rng.random(self.arm.model.nq)
            if self.judge.clearance(q) >= 2.0 * CLEARANCE:
                clear.append(self.arm.pose(q))
        return Poses(np.array([p.translation for p in clear]), np.array([p.rotation for p in clear]))

    def found(self, poses: Poses, **settings: Any) -> dict[str, Any]:
        """What a search makes of the poses."""
        order = [self.robot.joint_qpos_index(name) for name in self.arm.joints]
        given = {self.arm.frame: (poses.positions, poses.rotations)}

        def find() -> osik.InverseKinematicsSolution:
            return osik.inverse_kinematics(self.robot, given, limits=self.limits, **settings)

        find()
        start = time.perf_counter()
        solution = jax.block_until_ready(find())
        seconds = time.perf_counter() - start
        q, called = np.asarray(solution.q)[:, order].astype(float), np.asarray(solution.converged)
        away, turned = self.arm.errors(q, poses)
        clearance = np.array([self.judge.clearance(own) for own in q])
        there = (away <= POSITION) & (turned <= ORIENTATION)
        good = there & (clearance >= 0.0)
        return {
            "poses": len(q),
            "found": float(good.mean()),
            "wrongly called found": int((called & ~good).sum()),
            "limits broken": int(((q < self.arm.lower) | (q > self.arm.upper)).any(1).sum()),
            "least clearance of those found [m]": float(clearance[called].min(initial=np.inf)),
            "poses a second": len(q) / seconds,
        }


class Judge:
    """Distances by MuJoCo, between the same shapes."""

    def __init__(self, arm: Arm, ends: dict[str, np.ndarray], pairs: tuple[tuple[str, str], ...]) -> None:
        spec = mujoco.MjSpec.from_string(bodies_for_mujoco(arm.urdf))
        for link, end in ends.items():
            if np.linalg.norm(end) < _SHORT:
                numbers: dict[str, Any] = dict(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0.0, 0.0])
            else:
                numbers = dict(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[RADIUS, 0.0, 0.0], fromto=[0.0, 0.0, 0.0, *end]
                )
            spec.body(link).add_geom(name=f"{link} capsule", **numbers)
        for name, slab in WORLD.items():
            spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=slab.center, size=slab.size)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.order = [int(self.model.joint(name).qposadr[0]) for name in arm.joints]
        self.pairs = [(self.model.geom(a).id, self.model.geom(b).id) for a, b in pairs]

    def clearance(self, q: np.ndarray) -> float:
        """Of the pair that is nearest [m]."""
        self.data.qpos[self.order] = q
        mujoco.mj_kinematics(self.model, self.data)
        return min(mujoco.mj_geomDistance(self.model, self.data, a, b, 1.0, None) for a, b in self.pairs)


def _links(urdf: str) -> set[str]:
    return {body.name for body in mujoco.MjSpec.from_string(urdf).bodies}


def _shape(link: str, end: np.ndarray) -> osik.CollisionShape:
    if np.linalg.norm(end) < _SHORT:
        return osik.CollisionShape.sphere(RADIUS, frame=link)
    return osik.CollisionShape.capsule(RADIUS, np.zeros(3), end, frame=link)


def measured(name: str, count: int) -> dict[str, Any]:
    """One arm."""
    room = Room(name)
    poses = room.poses(count, np.random.default_rng(0))
    return {
        "as it comes": room.found(poses),
        f"{SEARCHES:,} searches": room.found(poses, seeds=SEARCHES, restarts=0),
    }


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ik.obstacles", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("results", type=Path, nargs="?")
    parser.add_argument("--robots", nargs="+", choices=("panda", "ur5", "xarm7"), default=["panda", "ur5"])
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    load = os.getloadavg()[0]
    results = {name: measured(name, given.poses) for name in given.robots}
    shown = Table("robot", "search", *next(iter(next(iter(results.values())).values())))
    for robot, kinds in results.items():
        for kind, row in kinds.items():
            shown.add_row(robot, kind, *(f"{value:.4g}" for value in row.values()))
    Console(width=160).print(shown)
    if given.results is not None:
        setting = {"precision": given.precision, "processor": processor(), "load average before": load}
        given.results.write_text(json.dumps({"setting": setting, "results": results}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    configure_cpu()
    main()
