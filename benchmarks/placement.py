"""Table of docs/data/measurements.md: bases for 50 poses, judged by Pinocchio and coal on the true collision meshes.

    python -m benchmarks.placement [NAME ...]

A judge with nothing of this library computes where the frames are, and the distances of the robot's collision shapes,
as its URDF has them, to the scene and to each other. Links with one joint or none between them are no pairs. Times are
of the second call, so without compiling, and of the first one.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
import warnings
from typing import Any

import coal
import jax
import numpy as np
import pinocchio as pin

import osik_jax as osik
from osik_jax.placement import Placement, place_base
from osik_jax.robot.loading._named import example_urdf

Boxes = dict[str, tuple[list[float], list[float]]]
Poses = tuple[np.ndarray, np.ndarray]
GRASP = 0.1034
"""Distance from a Panda's hand to the middle between its fingertips [m]."""
DOWN = np.diag([1.0, -1.0, -1.0])
ALONG_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
ALONG_Y = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
PALM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).T
"""Axes of TIAGo's hand, whose fingers point along x, in those of the poses, which point along z."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A robot, poses and a scene.

    Attributes:
        robot: name of the robot.
        locked: joints that stay, with their values [rad or m].
        frame: the frame of the poses.
        poses: positions (50, 3) and rotations (50, 3, 3); they point along z.
        tool: from the axes of the poses to those of the frame.
        boxes: half edges and centres [m].
        grid: arguments of ``place_base``.
    """

    robot: str
    locked: dict[str, float]
    frame: str
    poses: Poses
    tool: Poses
    boxes: Boxes
    grid: dict[str, Any]

    @property
    def targets(self) -> Poses:
        """Return the poses of the frame."""
        (position, turn), (offset, inner) = self.poses, self.tool
        return position + turn @ offset, turn @ inner

    def load(self) -> osik.Robot:
        """Return the robot with a fixed base."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", osik.OsikWarning)
            return osik.load_robot(self.robot, floating_base=False, locked_joints=self.locked)

    def place(self, robot: osik.Robot) -> Placement:
        """Return the placement."""
        scene = osik.Scene({name: osik.CollisionShape.box(*box) for name, box in self.boxes.items()})
        return place_base(robot, {self.frame: self.targets}, scene=scene, **self.grid)


def drawn(*parts: tuple[list[float], list[float], np.ndarray]) -> Poses:
    """Return 25 poses for each part: lower and upper corner of a box [m], and their rotation."""
    rng = np.random.default_rng(0)
    position = np.concatenate([rng.uniform(low, high, (25, 3)) for low, high, _ in parts])
    return position, np.concatenate([np.tile(turn, (25, 1, 1)) for *_, turn in parts])


def block() -> Boxes:
    """Return a solid table with a shelf behind it."""
    return {
        "table": ([0.3, 0.6, 0.2], [0.5, 0.0, 0.2]),
        "back": ([0.02, 0.4, 0.6], [1.1, 0.0, 0.6]),
        "low": ([0.15, 0.4, 0.01], [0.95, 0.0, 0.6]),
        "high": ([0.15, 0.4, 0.01], [0.95, 0.0, 0.95]),
        "left": ([0.15, 0.01, 0.6], [0.95, 0.4, 0.6]),
        "right": ([0.15, 0.01, 0.6], [0.95, -0.4, 0.6]),
    }


def room() -> Boxes:
    """Return a table on four legs, and a shelf on the left."""
    legs = {f"leg {x}{y}": ([0.02, 0.02, 0.34], [0.9 + 0.27 * x, 0.57 * y, 0.34]) for x in (-1, 1) for y in (-1, 1)}
    return legs | {
        "top": ([0.3, 0.6, 0.02], [0.9, 0.0, 0.7]),
        "back": ([0.4, 0.02, 0.6], [0.3, 1.35, 0.6]),
        "low": ([0.4, 0.15, 0.01], [0.3, 1.2, 0.8]),
        "high": ([0.4, 0.15, 0.01], [0.3, 1.2, 1.2]),
        "left": ([0.01, 0.15, 0.6], [-0.1, 1.2, 0.6]),
        "right": ([0.01, 0.15, 0.6], [0.7, 1.2, 0.6]),
    }


AT_BLOCK = drawn(([0.3, -0.4, 0.55], [0.7, 0.4, 0.65], DOWN), ([0.78, -0.25, 0.7], [0.85, 0.25, 0.85], ALONG_X))
IN_ROOM = drawn(([0.65, -0.3, 0.82], [0.88, 0.3, 0.92], DOWN), ([0.05, 1.0, 0.92], [0.55, 1.1, 1.05], ALONG_Y))
PANDA = Case(
    robot="panda",
    locked={"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
    frame="panda_hand",
    poses=AT_BLOCK,
    tool=(np.zeros(3), np.eye(3)),
    boxes=block(),
    grid=dict(x=np.linspace(-0.6, 1.2, 16), y=np.linspace(-1.1, 1.1, 14), yaw=4, height=0.3),
)
TIAGO = Case(
    robot="tiago",
    locked={"hand_*": 0.0, "wheel_*": 0.0, "head_*": 0.0},
    frame="hand_grasping_frame",
    poses=IN_ROOM,
    tool=(np.zeros(3), PALM),
    boxes=room(),
    grid=dict(x=np.linspace(-0.4, 0.8, 11), y=np.linspace(-0.5, 0.8, 12), yaw=8),
)
CASES = {
    "Panda, solid table, shelf behind": PANDA,
    "TIAGo, table on legs, shelf beside": TIAGO,
    "TIAGo, solid table, shelf behind": dataclasses.replace(
        TIAGO,
        poses=AT_BLOCK,
        tool=(np.array([0.0, 0.0, GRASP]), PALM),  # where the Panda's fingertips are
        boxes=block(),
        grid=dict(x=np.linspace(-0.8, 1.6, 13), y=np.linspace(-1.2, 1.2, 13), yaw=8),
    ),
}


class Judge:
    """Pinocchio's model of a robot with its locked joints, and coal's shapes of it."""

    def __init__(self, case: Case, robot: osik.Robot) -> None:
        path = example_urdf(case.robot)
        whole = pin.buildModelFromUrdf(str(path))
        shapes = pin.buildGeomFromUrdf(
            whole, str(path), pin.GeometryType.COLLISION, package_dirs=[str(path.parents[4])]
        )
        home, locked = pin.neutral(whole), [whole.getJointId(name) for name in robot.locked_joints]
        for name, value in case.locked.items():  # joints of the others stay at 0, which of a wheel is (cos, sin)
            if value:
                home[whole.idx_qs[whole.getJointId(name)]] = value
        self.model, self.shapes = pin.buildReducedModel(whole, shapes, locked, home)
        self.data, self.frame = self.model.createData(), self.model.getFrameId(case.frame)
        self.entries = [robot.joint_qpos_index(name) for name in self.model.names[1:]]
        joints = [shape.parentJoint for shape in self.shapes.geometryObjects]
        apart = lambda a, b: a != b and self.model.parents[a] != b and self.model.parents[b] != a  # noqa: E731
        self.pairs = [(i, j) for j in range(len(joints)) for i in range(j) if apart(joints[i], joints[j])]

    def judge(self, q: np.ndarray, base: tuple[np.ndarray, np.ndarray], case: Case, k: int) -> tuple[float, ...]:
        """Return the errors of pose ``k`` [m, rad], the distance to the scene, and that of the robot's own shapes [m].

        A distance is 0 where shapes touch.
        """
        pin.forwardKinematics(self.model, self.data, q[self.entries])
        pin.updateFramePlacements(self.model, self.data)
        stand = pin.SE3(base[1], base[0])
        frame, (position, turn) = stand * self.data.oMf[self.frame], case.targets
        error = np.linalg.norm(frame.translation - position[k]), np.linalg.norm(pin.log3(frame.rotation.T @ turn[k]))
        places = [
            _coal(stand * self.data.oMi[shape.parentJoint] * shape.placement) for shape in self.shapes.geometryObjects
        ]
        own = [shape.geometry for shape in self.shapes.geometryObjects]
        boxes = [
            (coal.Box(*np.multiply(2.0, half)), coal.Transform3s(np.eye(3), np.array(at)))
            for half, at in case.boxes.values()
        ]
        outer = min(_distance(a, at, *box) for a, at in zip(own, places, strict=True) for box in boxes)
        inner = min(_distance(own[i], places[i], own[j], places[j]) for i, j in self.pairs)
        return *map(float, error), outer, inner


def _coal(pose: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(pose.rotation, pose.translation)


def _distance(a: Any, at: coal.Transform3s, b: Any, there: coal.Transform3s) -> float:
    """Return the distance of two shapes [m]; 0 where they touch."""
    if coal.collide(a, at, b, there, coal.CollisionRequest(), coal.CollisionResult()):
        return 0.0
    return float(coal.distance(a, at, b, there, coal.DistanceRequest(), coal.DistanceResult()))


def measure(case: Case) -> tuple[Placement, dict[str, float]]:
    """Return the placement of a case, and its figures: times [s] and what the judge says."""
    robot, figures = case.load(), {}
    for name in ("first call", "second call"):
        start, processor = time.perf_counter(), time.process_time()
        found = case.place(robot)
        figures |= {name: time.perf_counter() - start, f"{name}, processor": time.process_time() - processor}
    judge, base = Judge(case, robot), found.best_pose
    said = [judge.judge(found.q[k], base, case, int(k)) for k in np.flatnonzero(found.is_reached)]
    worst = (max, max, min, min)
    names = "position error", "orientation error", "distance to the scene", "distance of own parts"
    return found, figures | {
        name: pick(part) for name, pick, part in zip(names, worst, zip(*said, strict=True), strict=True)
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(CASES), metavar="NAME")
    jax.config.update("jax_enable_x64", True)
    head = "case", "bases (stand free)", "best of the grid", "off the grid", "smallest margin", "to the scene [mm]"
    head += "own parts [mm]", "off the poses [mm, mrad]", "processor, wall [s]", "first call [s]"
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name in parser.parse_args().names:
        found, figures = measure(CASES[name])
        cells = [name, f"{found.stands_free.size} ({found.stands_free.sum()})"]
        cells += [f"{found.reached.max()} of {len(found.q)}", f"{found.is_reached.sum()} of {len(found.q)}"]
        cells += [f"{100 * np.nanmin(found.best_margin):.1f} %", f"{1e3 * figures['distance to the scene']:.1f}"]
        cells += [f"{1e3 * figures['distance of own parts']:.1f}"]
        cells += [f"{1e3 * figures['position error']:.2g}, {1e3 * figures['orientation error']:.2g}"]
        cells += [
            f"{figures['second call, processor']:.1f}, {figures['second call']:.1f}",
            f"{figures['first call']:.0f}",
        ]
        print(f"| {' | '.join(cells)} |\n{found.explain().splitlines()[2]}", flush=True)


if __name__ == "__main__":
    main()
