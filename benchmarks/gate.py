"""Has ours become slower? Times count as ratios to a reference kernel: factorisations by NumPy in the same run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from .judge import verdict
from .processes import Entrant, cores
from .race import Race

BASELINE = Path(__file__).with_name("baseline.json")
MARGIN = 1.5
"""A ratio may be so many times the baseline's: other CPUs weigh dispatch and arithmetic differently."""
ENTRANTS = {
    "one robot": {},
    "batch of 128": dict(batch=128),
}
"""What is watched, all on one core; options of our runner."""


def measured(race: Race) -> dict[str, dict[str, Any]]:
    """Rows by name."""
    entrants = [Entrant(name, "osik_jax", options, cores(1)) for name, options in ENTRANTS.items()]
    rows = race.run(entrants, rounds=9, steps=100, seconds=0.2)
    return {row["name"]: row | verdict(race.work, row.pop("motion")) for row in rows}


def verdicts(rows: dict[str, dict[str, Any]], baseline: dict[str, Any]) -> dict[str, str]:
    """Of each entrant, what is wrong with it; empty where nothing is.

    Raises:
        KeyError: the baseline is of other entrants.
    """
    found = {}
    for name, row in rows.items():
        most = baseline["margin"] * baseline["ratios"][name]
        slow = f"{row['kernel_ratio']:.3g} times the kernel > {most:.3g}" if row["kernel_ratio"] > most else ""
        found[name] = "; ".join(filter(None, [slow, *row["failures"]]))
    return found


def check(race: Race, console: Console, *, update: bool = False) -> int:
    """0 if nothing is slower than the margin allows and every motion is good; or a new baseline."""
    rows = measured(race)
    if update:
        ratios = {name: round(row["kernel_ratio"], 4) for name, row in rows.items()}
        record = dict(robot=race.work.robot, margin=MARGIN, ratios=ratios, versions=race.versions["osik_jax"])
        BASELINE.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        console.print(f"baseline written: {ratios}")
        return 0
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    found = verdicts(rows, baseline)
    table = Table("entrant", "µs a step", "times the kernel", "baseline", "verdict")
    for name, row in rows.items():
        ratios = f"{row['kernel_ratio']:.3g}", f"{baseline['ratios'][name]:.3g}"
        table.add_row(name, f"{1e6 * row['step_seconds_median']:.0f}", *ratios, found[name] or "good")
    console.print(table)
    return int(any(found.values()))
