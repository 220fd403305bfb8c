"""Collision-free inverse kinematics as one writes it with Pinocchio and coal, on the problems of ``collision_free``.

    python -m benchmarks.collision_free_peer ROBOT [--problems FILE.npz] [--count 10] [--starts 200]

Damped steps from random configurations, clipped into the joints' ranges, until one is at the pose (1 mm, 0.01 rad) with
all collision shapes free on the true meshes. It prints the share that is solved, and processor times. ROBOT is a robot
of example-robot-data whose problems have one frame, FILE.npz as for ``benchmarks.collision_free``. It needs Pinocchio
and coal.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from .ways_judge import Judge, scenes

STEPS, DAMPING, POSITION, ORIENTATION = 100, 1e-6, 1e-3, 1e-2


def main() -> None:
    """Solve the problems that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument("--problems", type=Path)
    parser.add_argument("--count", type=int, default=10, help="problems of each set")
    parser.add_argument("--starts", type=int, default=200, help="random configurations for a problem, at most")
    given = parser.parse_args()
    path = given.problems or Path(os.environ.get("OSIK_PROBLEMS", ".")) / f"{given.robot}.npz"
    head, problems = scenes(path)
    judge, rng = Judge(given.robot, head), np.random.default_rng(0)
    frame, rows = judge.model.getFrameId(head["frames"][0]), []
    for (_, index), problem in problems.items():
        if index > given.count:
            continue
        judge.place(problem["obstacles"])
        target = placed(judge, problem["goal"], frame)
        begin = time.process_time()
        found = any(reaches(judge, target, frame, rng) for _ in range(given.starts))
        rows.append((found, time.process_time() - begin))
    solved, seconds = np.array(rows).T
    print(
        f"{len(rows)} problems, solved {100 * solved.mean():.1f} %; processor time of one: median "
        f"{1e3 * np.median(seconds):.1f} ms, 95 % {1e3 * np.quantile(seconds, 0.95):.0f} ms"
    )


def placed(judge: Judge, joints: np.ndarray, frame: int) -> Any:
    """Return the pose of a frame at a configuration."""
    q = np.zeros(judge.model.nq)
    q[judge.entries] = joints
    pin.framesForwardKinematics(judge.model, judge.data, q)
    return judge.data.oMf[frame].copy()


def reaches(judge: Judge, target: Any, frame: int, rng: np.random.Generator) -> bool:
    """Return whether steps from a random configuration reach the target, and nothing touches there."""
    model, data = judge.model, judge.data
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    q = rng.uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi))
    for _ in range(STEPS):
        pin.framesForwardKinematics(model, data, q)
        error = pin.log6(data.oMf[frame].actInv(target)).vector
        if np.linalg.norm(error[:3]) < POSITION and np.linalg.norm(error[3:]) < ORIENTATION:
            return judge.is_free(q[judge.entries])
        J = pin.computeFrameJacobian(model, data, q, frame)
        q = np.clip(q + J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), error), low, high)
    return False


if __name__ == "__main__":
    main()
