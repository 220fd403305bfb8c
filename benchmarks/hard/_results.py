"""Rows of results, in memory and in a file: one for each entrant, case and gain."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from ..workload import Workload
from ._cases import Case, without_turning
from ._judge import Numbers, judged, worst
from ._motion import GAINS, HARD_FEET, OF_POSTURES, OURS, PEERS, REMEDIES, Entrant, motions

ROBOTS = ("arm7", "nao", "g1")
PRECISIONS = ("float64", "float32")
IN_BOTH = ("weighted",)
"""Schemes that run in single precision too where not all is asked for."""
REMEDIED = "g1"
"""The robot that shows what calms further."""
ON_FEET = ("nao", "g1")
"""Robots that show what hard feet do."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Of one case at one gain; of the kinds with several motions, the worst of each number."""

    entrant: Entrant
    case: str
    gain: float
    numbers: Numbers


def entrants(*, everything: bool, only: str = "") -> list[Entrant]:
    """Who takes part: by robot, then by what shares a compiled program, so that each compiles once.

    Args:
        everything: all schemes in both precisions, and remedies on all robots; else a part that takes minutes.
        only: a part of the names of those that are wanted.
    """
    found = [
        Entrant(robot, solver, precision, posture)
        for robot in ROBOTS
        for posture in (True, False)
        for solver in [*OURS, *_remedies(robot, everything=everything), *PEERS]
        for precision in PRECISIONS
        if precision == PRECISIONS[0] or (solver not in PEERS and (everything or solver in IN_BOTH))
        if posture or solver not in OF_POSTURES
    ]
    return [entrant for entrant in found if only in str(entrant)]


def _remedies(robot: str, *, everything: bool) -> list[str]:
    """Of this robot; hard feet where it has feet."""
    shown = REMEDIES if everything or robot == REMEDIED else (HARD_FEET,)
    return [name for name in shown if name != HARD_FEET or robot in ON_FEET]


def rows(entrant: Entrant, work: Workload, cases: Iterable[Case], pythons: Mapping[str, str]) -> Iterator[Row]:
    """All rows of one entrant.

    Raises:
        PeerUnavailable: the library is not installed.
    """
    work = without_turning(work, posture=entrant.posture)
    found: dict[tuple[str, float], list[Numbers]] = {}
    for motion in motions(entrant, work, list(cases), pythons):
        found.setdefault((motion.case.name, motion.gain), []).append(judged(work, motion))
    for (case, gain), numbers in found.items():
        yield Row(entrant, case, gain, worst(numbers))


def read(path: Path | None) -> list[Row]:
    """Those of a file; none where there is no file."""
    if path is None or not path.exists():
        return []
    given = json.loads(path.read_text(encoding="utf-8"))
    return [Row(Entrant(*row["entrant"]), row["case"], row["gain"], Numbers(**row["numbers"])) for row in given]


def keep(path: Path | None, given: Iterable[Row]) -> None:
    """Writes a file, if it has a name."""
    if path is not None:
        made = [dataclasses.asdict(row) | dict(numbers=row.numbers._asdict()) for row in given]
        path.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def by_gain(given: Iterable[Row], case: str) -> dict[Entrant, dict[float, Numbers]]:
    """Numbers of a case by entrant and gain."""
    found: dict[Entrant, dict[float, Numbers]] = {}
    for row in given:
        if row.case == case and row.gain in GAINS:
            found.setdefault(row.entrant, {})[row.gain] = row.numbers
    return found
