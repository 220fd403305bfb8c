"""The standard workload, by us and by the peers that are installed: one run, one machine, one judge.

    python -m benchmarks [results.json] [--quick] [--robot g1] [--peers osik_jax,mink,...] [--python placo=PATH]
    python -m benchmarks --gate [--update]

One step is forward kinematics, Jacobians, QP and integration; the clock counts from targets in NumPy to a
configuration in NumPy. One robot: every peer in a process of its own on the same core, in turns. Many: batches of ours
with all cores, and in turns with them as many processes of each peer as there are cores. Pinocchio scores each motion
in float64; a fast wrong answer is marked as failed. ``--python`` names the interpreter of a peer that needs an
environment of its own.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from . import gate, report
from .command_line import listed
from .descriptions import ROBOTS
from .peers import PEERS
from .processes import Entrant, cores
from .race import Race

SCHEMES = ("weighted", "null-space", "hierarchical")
PRECISIONS = ("float64", "float32")
BATCHES = (1, 64, 1024, 16384)


def ours(scheme: str, precision: str, *, pinned: bool = False, **options: Any) -> Entrant:
    """An entrant of this library."""
    parts = (scheme, precision, *(f"{key} {value}" for key, value in options.items()))
    chosen = dict(scheme=scheme, precision=precision, **options)
    return Entrant(f"osik_jax, {', '.join(parts)}", "osik_jax", chosen, cores(1) if pinned else ())


class Selection(NamedTuple):
    """What a run is made of."""

    schemes: Sequence[str] = SCHEMES
    precisions: Sequence[str] = PRECISIONS
    batches: Sequence[int] = BATCHES
    peers: Sequence[str] = tuple(PEERS)

    def others(self, pinned: tuple[int, ...], suffix: str = "") -> list[Entrant]:
        """The peers that are not ours."""
        return [Entrant(name + suffix, name, cores=pinned) for name in self.peers if name != "osik_jax"]

    def mine(self, **options: Any) -> list[Entrant]:
        """Ours in all schemes and precisions."""
        if "osik_jax" not in self.peers:
            return []
        if options.get("batch", 1) > 1:
            options |= dict(devices=len(cores()))
        return [ours(scheme, precision, **options) for scheme in self.schemes for precision in self.precisions]


QUICK = Selection(schemes=SCHEMES[:1], precisions=PRECISIONS[:1], batches=(1024,))


def one_robot(selection: Selection) -> list[Entrant]:
    """Everyone on one core."""
    return [*selection.others(cores(1)), *selection.mine(pinned=True)]


def many_robots(selection: Selection) -> list[list[Entrant]]:
    """Runs: the first scheme's largest batch beside peers in several processes, then each other batch alone."""
    everywhere = cores()
    crowd = selection.others(everywhere, f", {len(everywhere)} processes")
    groups = [[entrant] for batch in selection.batches for entrant in selection.mine(batch=batch)]
    beside = selection._replace(schemes=selection.schemes[:1]).mine(batch=max(selection.batches))
    return [[*crowd, *beside], *(group for group in groups if group[0] not in beside)]


def measure(race: Race, selection: Selection, *, quick: bool, part: str) -> dict[str, list[dict[str, Any]]]:
    """Rows of one robot and of many."""
    rounds, seconds = (5, 0.1) if quick else (10, 0.2)
    single, many = [], []
    if part != "many":
        entrants = one_robot(selection)
        single = race.run(entrants, rounds=rounds, ticks=200, seconds=seconds)
        for row in single:
            if row["peer"] == "osik_jax":
                (entrant,) = [entrant for entrant in entrants if entrant.name == row["name"]]
                row["first_tick_warm_seconds"] = race.again(entrant)
    if part != "one":
        for group in many_robots(selection):
            many += race.run(group, rounds=rounds, ticks=400, seconds=5 * seconds)
    return dict(one_robot=single, many_robots=many)


def settings() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--quick", action="store_true", help="about two minutes: one scheme and precision, fewer ticks")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--part", default="both", choices=("one", "many", "both"), help="one robot, or many")
    parser.add_argument("--peers", type=listed(str, PEERS), help=", ".join(PEERS))
    parser.add_argument("--schemes", type=listed(str, SCHEMES), help=", ".join(SCHEMES))
    parser.add_argument("--precisions", type=listed(str, PRECISIONS), help=", ".join(PRECISIONS))
    parser.add_argument("--batches", type=listed(int), help="sizes")
    parser.add_argument("--python", action="append", default=[], metavar="PEER=PATH", help="interpreter of a peer")
    parser.add_argument("--gate", action="store_true", help="compare ours with benchmarks/baseline.json")
    parser.add_argument("--update", action="store_true", help="with --gate: write the baseline anew")
    return parser.parse_args()


def main() -> int:
    """Prints tables; 1 where the gate fails or a motion of ours does."""
    given, console = settings(), Console(width=140)
    chosen = {key: getattr(given, key) for key in Selection._fields if getattr(given, key)}
    selection = (QUICK if given.quick else Selection())._replace(**chosen)
    pythons = dict(pair.split("=", 1) for pair in given.python)
    started = time.perf_counter()

    def tell(text: str) -> None:
        console.print(f"[dim]{time.perf_counter() - started:5.0f} s  {text}[/dim]")

    with Race(given.robot, pythons=pythons, report=tell) as race:
        if given.gate:
            return gate.check(race, console, update=given.update)
        rows = measure(race, selection, quick=given.quick, part=given.part)
    result = report.surroundings() | dict(
        command=shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
        robot=given.robot,
        seconds=time.perf_counter() - started,
        versions=race.versions,
        missing=race.missing,
        **rows,
    )
    if given.results is not None:
        given.results.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    report.show(console, result)
    return int(any(row["failures"] for part in rows.values() for row in part if row["peer"] == "osik_jax"))


if __name__ == "__main__":
    sys.exit(main())
