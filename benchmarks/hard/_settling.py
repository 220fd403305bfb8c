"""How the speed falls while a target stays out of reach: a root of the mean square for every two seconds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import jax
import numpy as np

from ..robots import workload
from ..workload import DT
from ._cases import CHUNK, Case, cases, without_turning
from ._judge import joint_speeds
from ._motion import GAINS, OURS, OurLoop
from ._results import ROBOTS

CHUNKS = 8
"""Of ``CHUNK`` steps each."""


def settling(robots: Iterable[str] = ROBOTS, solvers: Iterable[str] = OURS) -> Iterator[list[str]]:
    """Cells of a table's lines, the headings first: of the worst of three directions, by the smaller gain."""
    jax.config.update("jax_enable_x64", True)
    spans = (f"{k * CHUNK * DT:g} s to {(k + 1) * CHUNK * DT:g} s" for k in range(CHUNKS))
    yield ["robot", "solved by", "posture", *spans]
    for robot in robots:
        for posture in (True, False):
            work = without_turning(workload(robot), posture=posture)
            asked = [_longer(case) for case in cases(work) if case.name == "beyond"]
            for solver in solvers:
                loop = OurLoop(work, OURS[solver], posture=posture)
                speeds = [joint_speeds(work, loop.motion(case, GAINS[0])) for case in asked]
                worst = np.max([np.sqrt(np.mean(v.reshape(CHUNKS, -1) ** 2, axis=1)) for v in speeds], axis=0)
                yield [robot, solver, "yes" if posture else "no", *(f"{rms:.2g}" for rms in worst)]


def _longer(case: Case) -> Case:
    """The same target for longer."""
    hand, com = (np.tile(path[0], (CHUNKS * CHUNK, 1)) for path in (case.hand, case.com))
    return dataclasses.replace(case, hand=hand, com=com)
