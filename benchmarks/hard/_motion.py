"""Who does it, and what comes back: our rollouts, and the peers' loops in processes of their own."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik

from ..peers.ours import places, standing, tasks_of
from ..processes import Worker, started
from ..workload import DT, Workload
from ._cases import CHUNK, Case

Tasks = dict[str, osik.Task]

GAINS = (10.0, 200.0)
"""Of all tasks [1/s]; 200 asks for the whole error in one step."""


def _as_they_are(robot: osik.Robot, tasks: Tasks) -> Tasks:
    return tasks


def _slow_posture(robot: osik.Robot, tasks: Tasks) -> Tasks:
    """The posture with a gain of 1 /s."""
    return tasks | {"posture": tasks["posture"].replace(gain=1.0)}


def _posture_beside(robot: osik.Robot, tasks: Tasks) -> Tasks:
    """The posture at the hand's priority: both share by weight, as in the weighted scheme."""
    posture = tasks["posture"]
    assert isinstance(posture, osik.PostureTask)
    numbers: dict[str, Any] = dict(target=posture.target, weight=posture.weight, gain=posture.gain)
    return tasks | {"posture": osik.PostureTask(robot, **numbers, priority=tasks["hand"].priority)}


def _hard_feet(robot: osik.Robot, tasks: Tasks) -> Tasks:
    """The feet as constraints: where the hand's pull and theirs balance no longer matters."""
    return {name: _hard(robot, task) if _is_foot(task) else task for name, task in tasks.items()}


def _is_foot(task: osik.Task) -> bool:
    return isinstance(task, osik.FrameTask) and task.priority == 1


def _hard(robot: osik.Robot, foot: osik.Task) -> osik.FrameTask:
    assert isinstance(foot, osik.FrameTask)
    numbers: dict[str, Any] = dict(target=foot.target, gain=foot.gain)
    return osik.FrameTask(robot, foot.frame, **numbers, hard=True)


class Ours(NamedTuple):
    """A scheme with default numbers, or with what calms it further.

    Attributes:
        scheme: makes it.
        change: what is done to the tasks once they have their gain.
    """

    scheme: Callable[[], osik.Scheme]
    change: Callable[[osik.Robot, Tasks], Tasks] = _as_they_are


HARD_FEET = "weighted, feet hard"
OURS: Mapping[str, Ours] = {
    "weighted": Ours(osik.WeightedQP),
    "hierarchy": Ours(osik.HierarchicalQP),
    "null space": Ours(osik.NullSpace),
    "saturated null space": Ours(lambda: osik.NullSpace(method="saturated")),
}
REMEDIES: Mapping[str, Ours] = {
    HARD_FEET: Ours(osik.WeightedQP, _hard_feet),
    "weighted, damping 1e-2": Ours(lambda: osik.WeightedQP(damping=1e-2)),
    "hierarchy, damping 1e-2": Ours(lambda: osik.HierarchicalQP(damping=1e-2)),
    "hierarchy, posture of gain 1": Ours(osik.HierarchicalQP, _slow_posture),
    "hierarchy, posture beside the hand": Ours(osik.HierarchicalQP, _posture_beside),
    "saturated null space, damping 1e-2": Ours(lambda: osik.NullSpace(method="saturated", damping=1e-2)),
    "saturated null space, posture beside the hand": Ours(lambda: osik.NullSpace(method="saturated"), _posture_beside),
}
"""For where the default numbers do not come to rest."""
OF_POSTURES = frozenset(name for name, ours in REMEDIES.items() if ours.change in (_slow_posture, _posture_beside))
"""Those that change nothing where there is no posture task."""
SCHEMES = {**OURS, **REMEDIES}
PEERS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "mink": ("mink", {}),
    "mink, lm_damping 1": ("mink", dict(lm_damping=1.0)),
    "pink": ("pink", {}),
    "PlaCo": ("placo", {}),
}
"""What tables call them, their names in ``benchmarks.peers``, and options of their runners."""
ONE_GAIN = frozenset({"placo"})
"""Peers whose tasks always ask for their whole error."""


class Entrant(NamedTuple):
    """Who is asked.

    Attributes:
        robot: its name.
        solver: of ``SCHEMES`` or ``PEERS``.
        precision: ``float64`` or ``float32``; of peers always the first.
        posture: whether there is a posture task.
    """

    robot: str
    solver: str
    precision: str
    posture: bool

    def __str__(self) -> str:
        return ", ".join([self.robot, self.solver, self.precision, "posture" if self.posture else "no posture"])


class Motion(NamedTuple):
    """What came of a case.

    Attributes:
        case: which one.
        gain: of all tasks [1/s].
        path: canonical configurations, the start first. (steps + 1, nq)
        solved: share of the steps that the library calls solved, or in which it raised nothing.
        seconds: of a step, on average.
    """

    case: Case
    gain: float
    path: np.ndarray
    solved: float
    seconds: float


def motions(
    entrant: Entrant, work: Workload, cases: Sequence[Case], pythons: Mapping[str, str] | None = None
) -> Iterator[Motion]:
    """All cases at all gains.

    Args:
        entrant: who.
        work: its robot and weights.
        cases: what is asked.
        pythons: interpreters of peers that have an environment of their own.

    Raises:
        PeerUnavailable: the library is not installed.
    """
    if entrant.solver in SCHEMES:
        jax.config.update("jax_enable_x64", entrant.precision == "float64")
        loop = OurLoop(work, SCHEMES[entrant.solver], posture=entrant.posture)
        yield from (loop.motion(case, gain) for case in cases for gain in GAINS)
    else:
        yield from _theirs(entrant.solver, work, cases, pythons or {})


class OurLoop:
    """A robot of ours with the workload's tasks; the hand has a place to reach and no orientation."""

    def __init__(self, work: Workload, ours: Ours, *, posture: bool) -> None:
        self.work, self.robot, self.scheme, self.change = work, standing(work), ours.scheme(), ours.change
        self.order = places(self.robot, work)
        self.tasks = tasks_of(self.robot, work, self.robot.q0)
        self.tasks["hand"] = osik.FrameTask(
            self.robot, work.hand, rows="position", weight=work.costs.hand_position**2, priority=3
        )
        if not posture:
            del self.tasks["posture"]
        rest = np.tile(work.hand_position, (CHUNK, 1)), np.tile(work.com_start, (CHUNK, 1))
        self._chunk(self.robot.q0, GAINS[0], *rest)  # compiles

    def motion(self, case: Case, gain: float) -> Motion:
        """From the start, one compiled rollout after the other."""
        q, parts, solved = self.robot.q0, [self.work.start[None]], []
        begun = time.perf_counter()
        for first in range(0, len(case.hand), CHUNK):
            chunk = self._chunk(q, gain, case.hand[first : first + CHUNK], case.com[first : first + CHUNK])
            q = chunk.q[-1]
            parts.append(np.asarray(chunk.q[1:], float)[:, self.order])
            solved.append(np.asarray(chunk.solution.status) == osik.Status.SOLVED)
        seconds = (time.perf_counter() - begun) / len(case.hand)
        return Motion(case, gain, np.concatenate(parts), float(np.mean(solved)), seconds)

    def _chunk(self, q: jax.Array, gain: float, hand: np.ndarray, com: np.ndarray) -> osik.Trajectory:
        tasks = self.change(self.robot, {name: task.replace(gain=gain) for name, task in self.tasks.items()})
        turned = jnp.broadcast_to(jnp.eye(3, dtype=q.dtype), (CHUNK, 3, 3))
        targets: dict[str, Any] = dict(hand=(jnp.asarray(hand, q.dtype), turned))
        if "com" in tasks:
            targets["com"] = jnp.asarray(com, q.dtype)
        return osik.rollout(self.robot, q, tasks, scheme=self.scheme, dt=DT, steps=CHUNK, targets=targets)


def _theirs(solver: str, work: Workload, cases: Sequence[Case], pythons: Mapping[str, str]) -> Iterator[Motion]:
    name, options = PEERS[solver]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "workload.json"
        file.write_text(work.to_json(), encoding="utf-8")
        python = pythons.get(name, sys.executable)
        with started(name, {}, workload=file, python=python, cache=Path(folder)) as worker:
            for case in cases:
                for gain in GAINS[-1:] if name in ONE_GAIN else GAINS:
                    own = {} if name in ONE_GAIN else dict(gain=gain * DT)
                    yield _followed(worker, case, gain, {**options, **own})


def _followed(worker: Worker, case: Case, gain: float, options: Mapping[str, Any]) -> Motion:
    found = worker.ask(what="follow", hand=case.hand.tolist(), com=case.com.tolist(), options=options)
    return Motion(case, gain, np.array(found["motion"]), found["solved"], float(np.mean(found["seconds"])))
