"""TRAC-IK by pytracik, in an environment of its own: ``PYTHON -m benchmarks.ik.with_pytracik``; NumPy is all it shares.

A question is one object of JSON on the standard input, the answer one on the standard output. TRAC-IK takes a time in
the place of a number of starts: within it, it searches in two ways side by side and starts again by itself.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib import import_module
from importlib.metadata import version
from typing import Any

import numpy as np

TIMEOUT = 0.05
"""For a pose [s]: ten times its own default."""


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """x y z w of a rotation matrix: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    lower = [
        [a - e - i, 0, 0, 0],
        [b + d, e - a - i, 0, 0],
        [c + g, f + h, i - a - e, 0],
        [h - f, c - g, d - b, a + e + i],
    ]
    return np.linalg.eigh(np.array(lower))[1][:, -1]


def answered(question: dict[str, Any]) -> dict[str, Any]:
    """Configurations from the middle of the ranges on, which of them it calls found, and seconds."""
    tracik: Any = import_module("pytracik")  # in its own environment, where nothing checks types
    lower, upper = np.array(question["lower"]), np.array(question["upper"])
    solver = tracik.TRAC_IK(
        question["base"], question["frame"], question["urdf"], TIMEOUT, question["tolerance"], tracik.SolveType.Speed
    )
    tracik.set_joint_limits(solver, lower.tolist(), upper.tolist())  # those of the URDF are in single precision
    middle = 0.5 * (lower + upper)
    poses = [
        (*position, *quaternion(np.array(rotation)))
        for position, rotation in zip(question["positions"], question["rotations"], strict=True)
    ]
    started = time.perf_counter()
    answers = [tracik.ik(solver, middle, *pose) for pose in poses]
    seconds = time.perf_counter() - started
    found = [bool(answer[0] >= 0.0) for answer in answers]
    q = [(answer[1:] if good else middle).tolist() for answer, good in zip(answers, found, strict=True)]
    return dict(q=q, found=found, seconds=seconds, version=version("pytracik"))


def main() -> None:
    """Answers one question; what the library prints goes to the standard error."""
    reply = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    print(json.dumps(answered(json.load(sys.stdin))), file=reply)


if __name__ == "__main__":
    main()
