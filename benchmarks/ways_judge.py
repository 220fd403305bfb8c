"""Ways around obstacles judged by Pinocchio and coal on the true meshes, and OMPL's ways on the same problems.

    python -m benchmarks.ways_judge ROBOT WAYS.npz [--problems FILE.npz]
    python -m benchmarks.ways_judge ROBOT --ompl COUNT [--problems FILE.npz]

WAYS.npz is what ``benchmarks.ways`` wrote: each of its states is tried. ``--ompl`` solves the first COUNT problems of
each set by RRT-Connect and OMPL's simplification, with the same check at OMPL's default resolution. Then 2,000 states
of each way are tried. ROBOT is a robot of example-robot-data, FILE.npz as for ``benchmarks.ways``. It needs Pinocchio,
coal, and for ``--ompl`` the package ompl.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from osik_jax.robot.loading._named import example_urdf

_SECONDS, _STATES = 20.0, 2000


class Judge:
    """Pinocchio's model of a robot with its held joints locked, and the collision shapes of its URDF.

    Args:
        name: of the robot.
        head: of the file of problems: joints, held joints, pairs of links that may touch.
    """

    def __init__(self, name: str, head: dict[str, Any]) -> None:
        path = example_urdf(name)
        folders, kind = [str(path.parents[4])], pin.GeometryType.COLLISION
        whole = pin.buildModelFromUrdf(str(path))
        shapes = pin.buildGeomFromUrdf(whole, str(path), kind, package_dirs=folders)
        home = pin.neutral(whole)
        for joint, value in head["held"].items():
            if whole.existJointName(joint):
                home[whole.idx_qs[whole.getJointId(joint)]] = value
        locked = [k for k, joint in enumerate(whole.names) if k and joint not in head["joints"]]
        self.model, self.shapes = pin.buildReducedModel(whole, shapes, locked, home)
        self.data, self.own = self.model.createData(), self.shapes.ngeoms
        self.entries = [self.model.idx_qs[self.model.getJointId(joint)] for joint in head["joints"]]
        allowed = {frozenset(pair) for pair in head["allowed"]}
        links = [self.model.frames[shape.parentFrame].name for shape in self.shapes.geometryObjects]
        joints = [shape.parentJoint for shape in self.shapes.geometryObjects]

        def near(a: int, b: int) -> bool:
            return a == b or self.model.parents[a] == b or self.model.parents[b] == a

        self.pairs = [
            pin.CollisionPair(i, j)
            for j in range(self.own)
            for i in range(j)
            if not near(joints[i], joints[j]) and frozenset((links[i], links[j])) not in allowed
        ]

    def place(self, obstacles: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
        """Take a scene: kind (0 box, 1 cylinder), half edges or radius and half length, and pose of each obstacle."""
        self.around = self.shapes.copy()
        self.around.removeAllCollisionPairs()
        for pair in self.pairs:
            self.around.addCollisionPair(pair)
        for k, (kind, size, pose) in enumerate(obstacles):
            shape = coal.Box(*(2.0 * size)) if kind == 0 else coal.Cylinder(size[0], 2.0 * size[1])
            at = pin.SE3(pin.Quaternion(*pose[3:]).normalized(), pose[:3])
            other = self.around.addGeometryObject(pin.GeometryObject(f"obstacle {k}", 0, at, shape))
            for own in range(self.own):
                self.around.addCollisionPair(pin.CollisionPair(own, other))
        self.found = self.around.createData()

    def is_free(self, joints: np.ndarray) -> bool:
        """Return whether no pair of shapes touches."""
        q = np.zeros(self.model.nq)
        q[self.entries] = joints
        return not pin.computeCollisions(self.model, self.data, self.around, self.found, q, True)


def scenes(path: Path) -> tuple[dict[str, Any], dict[tuple[str, int], dict[str, Any]]]:
    """Return the head of a file of problems; by set and index the obstacles, the start and the goal."""
    with np.load(path) as opened:
        file = {name: opened[name] for name in opened.files}
    head, found = json.loads(str(file["head"])), {}
    for k, end in enumerate(np.cumsum(file["objects"].astype(int))):
        rows = range(end - int(file["objects"][k]), end)
        obstacles = [
            (int(file["kind"][row]), file["sizes"][file["size"][row]].astype(float), file["pose"][:, row].astype(float))
            for row in rows
        ]
        own = {"obstacles": obstacles, "start": file["start"][k].astype(float), "goal": file["goal"][k].astype(float)}
        found[head["sets"][file["set"][k]], int(file["index"][k])] = own
    return head, found


def judge_ways(judge: Judge, problems: dict[tuple[str, int], dict[str, Any]], file: Any) -> None:
    """Print how many states of the ways touch something."""
    ends, touching, tried = np.cumsum(file["states"]), 0, 0
    for name, index, found, count, end in zip(
        file["set"], file["index"], file["found"], file["states"], ends, strict=True
    ):
        if found:
            judge.place(problems[str(name), int(index)]["obstacles"])
            wrong = sum(not judge.is_free(q) for q in file["q"][end - count : end])
            touching, tried = touching + (wrong > 0), tried + int(count)
            if wrong:
                print(f"{name} {index}: {wrong} of {count} states touch")
    print(f"{int(file['found'].sum())} ways, {tried:,} states; {touching} ways touch something")


def ompl_way(judge: Judge, problem: dict[str, Any]) -> tuple[float, list[np.ndarray]]:
    """Return the processor time of OMPL for a problem [s], and states of its way, none if there is no way."""
    from ompl import base, geometric  # pyright: ignore[reportMissingImports]

    n, (start, goal) = len(problem["start"]), (problem[k] for k in ("start", "goal"))
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    low, high = judge.model.lowerPositionLimit[judge.entries], judge.model.upperPositionLimit[judge.entries]
    for k in range(n):
        bounds.setLow(k, float(min(low[k], start[k], goal[k])))
        bounds.setHigh(k, float(max(high[k], start[k], goal[k])))
    space.setBounds(bounds)
    setup, ends = geometric.SimpleSetup(space), [space.allocState(), space.allocState()]
    for state, values in zip(ends, (start, goal), strict=True):
        for k in range(n):
            state[k] = float(values[k])
    setup.setStateValidityChecker(lambda state: judge.is_free(np.array([state[k] for k in range(n)])))
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    begin = time.process_time()
    if setup.solve(_SECONDS):
        setup.simplifySolution()
    seconds = time.process_time() - begin
    if not setup.haveExactSolutionPath():
        return seconds, []
    path = setup.getSolutionPath()
    path.interpolate(_STATES)
    return seconds, [np.array([state[k] for k in range(n)]) for state in path.getStates()]


def beside_ompl(judge: Judge, problems: dict[tuple[str, int], dict[str, Any]], count: int) -> None:
    """Print OMPL's times, how many ways it finds, and how many touch something between the states it has checked."""
    from ompl import util  # pyright: ignore[reportMissingImports]

    util.setLogLevel(util.LogLevel.LOG_ERROR)
    seen: dict[str, int] = {}
    seconds, found, touching = [], 0, 0
    for (name, _), problem in problems.items():
        seen[name] = seen.get(name, 0) + 1
        if seen[name] <= count:
            judge.place(problem["obstacles"])
            took, states = ompl_way(judge, problem)
            seconds.append(took)
            found += bool(states)
            touching += not all(map(judge.is_free, states))
    print(
        f"OMPL, {len(seconds)} problems: {found} found, processor time: median {1e3 * np.median(seconds):.0f} ms, "
        f"95 % {1e3 * np.quantile(seconds, 0.95):.0f} ms; {touching} ways touch something between checked states"
    )


def main() -> None:
    """Judge ways, or let OMPL find some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument("ways", type=Path, nargs="?")
    parser.add_argument("--ompl", type=int, metavar="COUNT")
    parser.add_argument("--problems", type=Path)
    given = parser.parse_args()
    head, problems = scenes(given.problems or Path(os.environ.get("OSIK_PROBLEMS", ".")) / f"{given.robot}.npz")
    judge = Judge(given.robot, head)
    if given.ompl:
        beside_ompl(judge, problems, given.ompl)
    if given.ways:
        with np.load(given.ways) as file:
            judge_ways(judge, problems, {name: file[name] for name in file.files})


if __name__ == "__main__":
    main()
