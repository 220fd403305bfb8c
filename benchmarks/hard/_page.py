"""The table of docs/hard_work.md, and the files with all numbers in docs/data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..data_file import DATA, DOCS, write_between, write_csv
from ._judge import Numbers
from ._motion import GAINS, OURS, PEERS, Entrant
from ._results import ROBOTS, Row, by_gain

PAGE = DOCS / "hard_work.md"
FILE, SETTLING = DATA / "hard_work.csv", DATA / "settling.csv"
CALM = 0.1
"""The rms joint speed of a robot at rest [rad/s]."""
FEET = 2e-3
"""How far feet may be off [m]."""
HALF = 0.5
"""The share of its top speed that no joint of a stretched arm should need."""


class Column(NamedTuple):
    """A number, how it is written, and the most that is good."""

    head: str
    shown: Callable[[Numbers], float]
    form: str = "{:.2g}"
    most: float = float("inf")


RMS = Column("rms speed [rad/s]", lambda n: n.rms, "{:.2g}", CALM)
MOVING = Column("rms speed [rad/s]", lambda n: n.rms)
FASTEST = Column("fastest / top speed", lambda n: n.fastest, "{:.2f}")
GENTLE = Column("fastest / top speed", lambda n: n.fastest, "{:.2f}", HALF)
TURNS = Column("turns [1/s]", lambda n: n.turns, "{:.0f}")
AT_TOP = Column("at top speed [%]", lambda n: 1e2 * n.at_top, "{:.3g}")
STILL = Column("at top speed [%]", lambda n: 1e2 * n.at_top, "{:.3g}", 0.0)
AT_RANGE = Column("at a range's end [%]", lambda n: 1e2 * n.at_range, "{:.3g}")
FEET_OFF = Column("feet off [mm]", lambda n: 1e3 * n.feet, "{:.2g}", 1e3 * FEET)
HAND = Column("hand off [mm]", lambda n: 1e3 * n.hand, "{:.3g}")
AT_END = Column("hand off at the end [mm]", lambda n: 1e3 * n.hand_at_end, "{:.3g}")
BASE = Column("base [m/s]", lambda n: n.base, "{:.1f}")
SOLVED = Column("not solved [%]", lambda n: 1e2 * (1.0 - n.solved), "{:.2g}")
TIME = Column("µs a step", lambda n: 1e6 * n.seconds, "{:.0f}")

TABLES: Mapping[str, Sequence[Column]] = {
    "beyond": (RMS, FASTEST, TURNS, STILL, AT_RANGE, FEET_OFF, AT_END, SOLVED),
    "stretch": (MOVING, GENTLE, TURNS, AT_TOP, FEET_OFF, AT_END, SOLVED),
    "jumps": (MOVING, TURNS, AT_TOP, FEET_OFF, BASE, SOLVED),
    "squat": (MOVING, FASTEST, TURNS, AT_TOP, AT_RANGE, FEET_OFF, SOLVED),
    "inside": (FASTEST, TURNS, FEET_OFF, HAND, SOLVED),
}
"""Columns of each case's table."""
COLUMNS = (MOVING, FASTEST, TURNS, AT_TOP, AT_RANGE, FEET_OFF, HAND, AT_END, BASE, SOLVED)
"""Columns of the file with all numbers."""
HEAD = ("case", "robot", "solved by", "posture", "gain [1/s]", *(column.head for column in COLUMNS))


def tables(given: Sequence[Row], *, times: bool) -> dict[str, str]:
    """As Markdown, by name: one for each case, and the summary."""
    columns = {case: [*shown, *((TIME,) if times else ())] for case, shown in TABLES.items()}
    return {case: _table(given, case, columns[case]) for case in TABLES} | {"summary": _summary(given)}


def write(given: Sequence[Row], path: Path = PAGE, file: Path = FILE) -> None:
    """Write the summary into the page, between its marks, and all numbers into the file."""
    write_between(_summary(given), path, start="<!-- table: summary -->\n", end="<!-- end: summary -->\n")
    write_csv(file, HEAD, map(_cells, sorted(given, key=lambda row: tuple(TABLES).index(row.case))))


def _cells(row: Row) -> list[str]:
    entrant = row.entrant
    numbers = [_written(column._replace(most=float("inf")), column.shown(row.numbers)) for column in COLUMNS]
    return [row.case, entrant.robot, _name(entrant), "yes" if entrant.posture else "no", f"{row.gain:g}", *numbers]


def _name(entrant: Entrant) -> str:
    return entrant.solver + ("" if entrant.precision == "float64" else f", {entrant.precision}")


def _table(given: Iterable[Row], case: str, columns: Sequence[Column]) -> str:
    """A line for each entrant; a cell has a number for each gain, in bold where it is more than it should be."""
    found = by_gain(given, case)
    lines = [_line(["robot", "solved by", "posture", *(column.head for column in columns)])]
    lines.append("|" + "---|" * (3 + len(columns)))
    for entrant in sorted(found, key=lambda e: ROBOTS.index(e.robot)):
        cells = [_cell(column, found[entrant]) for column in columns]
        lines.append(_line([entrant.robot, _name(entrant), "yes" if entrant.posture else "no", *cells]))
    return "\n".join(lines) + "\n"


def _cell(column: Column, by: Mapping[float, Numbers]) -> str:
    return " / ".join(_written(column, column.shown(by[gain])) if gain in by else "-" for gain in GAINS)


def _written(column: Column, value: float) -> str:
    text = column.form.format(value) if abs(value) > 1e-6 else "0"
    return text if value <= column.most else f"**{text}**"


CRITERIA: Mapping[str, tuple[str, Callable[[Numbers], bool]]] = {
    "beyond: rms speed at most 0.1 rad/s": ("beyond", lambda n: n.rms <= CALM),
    "beyond: no joint at its top speed": ("beyond", lambda n: n.at_top == 0.0),
    "beyond: feet within 2 mm": ("beyond", lambda n: n.feet <= FEET),
    "stretch: no joint above half its top speed": ("stretch", lambda n: n.fastest <= HALF),
    "stretch: the hand is back within 1 mm": ("stretch", lambda n: n.hand_at_end <= 1e-3),
    "all: every step solved": ("", lambda n: n.solved == 1.0),
}
"""What a run has to do, and of which case."""


def _summary(given: Sequence[Row]) -> str:
    """How many runs of each solver do what they have to: a run is a robot, a posture or none, a gain, a case."""
    lines = [_line(["solved by", *CRITERIA]), "|" + "---|" * (1 + len(CRITERIA))]
    for solver in (*OURS, *PEERS):
        own = [row for row in given if row.entrant.solver == solver]
        for precision in sorted({row.entrant.precision for row in own}, reverse=True):
            rows = [row for row in own if row.entrant.precision == precision]
            name = solver + ("" if precision == "float64" else f", {precision}")
            lines.append(_line([name, *(_counted(rows, *wanted) for wanted in CRITERIA.values())]))
    return "\n".join(lines) + "\n"


def _counted(rows: Iterable[Row], case: str, fine: Callable[[Numbers], bool]) -> str:
    good = [fine(row.numbers) for row in rows if row.case == case or not case]
    return f"{sum(good)} of {len(good)}"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
