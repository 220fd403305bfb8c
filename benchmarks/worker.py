"""A process that runs one peer, told by lines of JSON what to do next: ``python -m benchmarks.worker PEER WORKLOAD``.

It needs NumPy and its peer, nothing else, so that a peer may live in an environment of its own. Questions come on the
standard input, each answer is a line on the standard output; whatever else is printed goes to the standard error.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .machine import peak_bytes
from .peers import peer, versions
from .workload import Workload

JUDGED_LANES = 4
"""Of a batch, whose motions are reported."""
KERNEL = (256, 35)
"""Matrices that the reference kernel factors, and their size: that of G1's QP."""


class Loop:
    """A peer, the step that it has come to, and its motion so far."""

    def __init__(self, work: Workload, name: str, options: dict[str, Any]) -> None:
        self.work, self.now = work, 0
        self.batch: int | None = options.get("batch")
        self.made = peer(name)
        started = time.perf_counter()
        self.runner = self.made(work, **options)
        self.build_seconds = time.perf_counter() - started

    def run(self, steps: int) -> dict[str, Any]:
        """Seconds of each step, and the canonical configurations that they led to: (lanes, steps, nq)."""
        lanes = 0 if self.batch is None else np.arange(self.batch)
        seconds, motion = [], []
        for step in range(self.now, self.now + steps):
            hand, com = self.work.hand_at(step, lanes), self.work.com_at(step)
            started = time.perf_counter()
            q = self.runner.step(hand, com)
            seconds.append(time.perf_counter() - started)
            motion.append(self.runner.canonical(q if self.batch is None else q[:JUDGED_LANES]))
        self.now += steps
        paths = np.array(motion)[None] if self.batch is None else np.array(motion).swapaxes(0, 1)
        return dict(seconds=seconds, motion=paths.tolist(), solved=self.runner.solved())

    def follow(self, hand: np.ndarray, com: np.ndarray, options: dict[str, Any]) -> dict[str, Any]:
        """A motion of one robot from the start along given targets; where the library raises, it stands still.

        Args:
            hand, com: targets at each step. (steps, 3)
            options: of the runner that is made for it.
        """
        runner, seconds, failed = self.made(self.work, **options), [], 0
        motion = [self.work.start]
        for targets in zip(hand, com, strict=True):
            started = time.perf_counter()
            try:
                found = runner.step(*targets)
                motion.append(runner.canonical(found))
            except Exception as reason:  # whatever a QP solver raises where it finds nothing
                failed += 1
                print(f"step {len(motion)}: {reason}", file=sys.stderr)
                motion.append(motion[-1])
            seconds.append(time.perf_counter() - started)
        return dict(seconds=seconds, motion=np.array(motion).tolist(), solved=1.0 - failed / len(hand))


def reference_kernel() -> float:
    """Seconds of a batch of Cholesky factorisations by NumPy: what this machine is worth now."""
    count, n = KERNEL
    matrices = np.random.default_rng(0).normal(size=(count, n, n))
    matrices = matrices @ matrices.swapaxes(1, 2) + n * np.eye(n)
    started = time.perf_counter()
    np.linalg.cholesky(matrices)
    return time.perf_counter() - started


def answer(loop: Loop, question: dict[str, Any]) -> dict[str, Any]:
    """What a question asks for.

    Raises:
        ValueError: it is none that a worker knows.
    """
    match question["what"]:
        case "run":
            return loop.run(question["steps"])
        case "follow":
            return loop.follow(np.array(question["hand"]), np.array(question["com"]), question["options"])
        case "kernel":
            return dict(seconds=[reference_kernel() for _ in range(question["times"])])
        case "memory":
            device = loop.runner.device()
            return dict(peak_bytes=peak_bytes(), device=device.name, device_peak_bytes=device.peak_bytes)
        case unknown:
            raise ValueError(f"a worker knows no {unknown!r}; it knows run, follow, kernel and memory")


def main() -> None:
    """Says what it is, then answers until its input ends."""
    replies = _private_output()
    name, path, options = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3])
    core = options.pop("core", None)
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    loop = Loop(Workload.from_json(path.read_text(encoding="utf-8")), name, options)
    found = versions(loop.runner.packages) | dict(python=platform.python_version())
    print(json.dumps(dict(versions=found, build_seconds=loop.build_seconds)), file=replies, flush=True)
    for line in sys.stdin:
        print(json.dumps(answer(loop, json.loads(line))), file=replies, flush=True)


def _private_output() -> TextIO:
    """The standard output, for answers alone: what libraries print goes to the standard error from now on."""
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return replies


if __name__ == "__main__":
    main()
