"""Entrants take turns, each in its own processes; each ends as a row of numbers with a judgement beside them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .processes import Entrant, PeerUnavailable, Team
from .workload import Workload

WARM_UP = 10
"""Steps before the clock counts, after the first one, which compiles."""
FEWEST = 5
"""Steps of a turn, at least."""
KERNELS = 20
"""Runs of the reference kernel before each turn."""
UNDISTURBED = 20
"""Percentile that the ratio to the kernel is made of: what other processes take shows in higher ones."""


class Race:
    """Runs on one robot. A context manager: on leaving it forgets the programs that it compiled.

    Args:
        work: what everyone does.
        pythons: interpreters of peers that have an environment of their own.
        report: told what happens.

    Attributes:
        versions: of what each peer is made of, so far.
        missing: peers that did not start, and why.
    """

    def __init__(self, work: Workload, *, pythons: Mapping[str, str], report: Callable[[str], None]) -> None:
        self.work, self.pythons, self.report = work, pythons, report
        self.missing: dict[str, str] = {}
        self.versions: dict[str, dict[str, str]] = {}
        self._folder = tempfile.TemporaryDirectory()
        self._workload = Path(self._folder.name) / "workload.json"
        self._workload.write_text(self.work.to_json(), encoding="utf-8")

    def __enter__(self) -> Race:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def run(self, entrants: Iterable[Entrant], *, rounds: int, steps: int, seconds: float) -> list[dict[str, Any]]:
        """Rows of those entrants that could start, not judged yet.

        Args:
            entrants: who takes part, in turns.
            rounds: turns of each.
            steps: of a turn, at most.
            seconds: that a turn may take; it has ``FEWEST`` steps at least.
        """
        records = [Record(team) for team in map(self._started, entrants) if team]
        try:
            for record in records:
                self.report(f"{record.team.entrant.name}: first steps")
                record.warm_up(steps, seconds)
            for _ in range(rounds):
                for record in records:
                    record.take_turn()
            for record in records:
                record.weigh()
        finally:
            for record in records:
                record.team.close()
        return [record.row() for record in records]

    def again(self, entrant: Entrant) -> float:
        """Seconds of the first step in a new process, with its programs from the compilation cache."""
        team = self._team(entrant)
        try:
            return team.ask(what="run", steps=1)[0]["seconds"][0]
        finally:
            team.close()

    def _started(self, entrant: Entrant) -> Team | None:
        if entrant.peer in self.missing:
            return None
        try:
            team = self._team(entrant)
        except PeerUnavailable as reason:
            self.missing[entrant.peer] = str(reason)
            self.report(f"{entrant.peer} is left out: {reason}")
            return None
        self.versions[entrant.peer] = team.workers[0].hello["versions"]
        return team

    def _team(self, entrant: Entrant) -> Team:
        cache = Path(self._folder.name) / "programs"
        return Team(entrant, workload=self._workload, pythons=self.pythons, cache=cache)


class Record:
    """What one entrant has done."""

    def __init__(self, team: Team) -> None:
        self.team = team
        self.steps, self.first, self.solved = FEWEST, 0.0, 1.0
        self.seconds: list[list[float]] = [[] for _ in team.workers]
        self.kernel: list[float] = []
        self.motion: list[list[Any]] = []
        self.memory: list[dict[str, Any]] = []

    def warm_up(self, steps: int, seconds: float) -> None:
        """The first steps, which are judged but not timed; they set how many steps a turn has."""
        self.first = self._moved(1)[0][0]
        each = float(np.median(self._moved(WARM_UP)[0]))
        self.steps = int(np.clip(seconds / each, FEWEST, max(steps, FEWEST)))

    def take_turn(self) -> None:
        """Some steps in all its processes at once, after the reference kernel in the first."""
        self.kernel.extend(self.team.workers[0].ask(what="kernel", times=KERNELS)["seconds"])
        for own, found in zip(self.seconds, self._moved(self.steps), strict=True):
            own.extend(found)

    def weigh(self) -> None:
        """What its processes have had in memory."""
        self.memory = self.team.ask(what="memory")

    def _moved(self, steps: int) -> list[list[float]]:
        answers = self.team.ask(what="run", steps=steps)
        self.solved = min(answer["solved"] for answer in answers)
        for lane, path in enumerate(answers[0]["motion"]):
            if lane == len(self.motion):
                self.motion.append([])
            self.motion[lane].extend(path)
        return [answer["seconds"] for answer in answers]

    def row(self) -> dict[str, Any]:
        """Times in seconds; ``kernel_ratio`` is an undisturbed step over an undisturbed reference kernel.

        ``peak_bytes`` is of one process. ``motion`` has the canonical configurations of some robots, for the judge:
        (robots, steps, nq).
        """
        entrant, pooled = self.team.entrant, np.concatenate([np.asarray(own) for own in self.seconds])
        kernel = float(np.percentile(self.kernel, UNDISTURBED))
        return dict(
            name=entrant.name,
            peer=entrant.peer,
            options=dict(entrant.options),
            cores=list(entrant.cores),
            robots=entrant.robots,
            timed_steps=len(pooled),
            judged_steps=len(self.motion[0]),
            step_seconds_median=float(np.median(pooled)),
            step_seconds_p99=float(np.percentile(pooled, 99)),
            steps_per_second=(entrant.options.get("batch") or 1) * sum(1.0 / float(np.mean(s)) for s in self.seconds),
            kernel_seconds=kernel,
            kernel_ratio=float(np.percentile(pooled, UNDISTURBED)) / kernel,
            build_seconds=self.team.workers[0].hello["build_seconds"],
            first_step_seconds=self.first,
            device=self.memory[0]["device"],
            peak_bytes=_largest([each["peak_bytes"] for each in self.memory]),
            device_peak_bytes=_largest([each["device_peak_bytes"] for each in self.memory]),
            solved=self.solved,
            motion=np.array(self.motion),
        )


def _largest(given: Sequence[int | None]) -> int | None:
    known = [each for each in given if each is not None]
    return max(known, default=None)
