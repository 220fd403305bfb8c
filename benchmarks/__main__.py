"""The standard workload, by us and by the peers that are installed: one run, one machine, one judge.

    python -m benchmarks [results.json] [--quick] [--robot g1] [--peers osik_jax,mink,...] [--python placo=PATH]
    python -m benchmarks --gate [--update]
    python -m benchmarks results.json --judge

One step is forward kinematics, Jacobians, QP and integration; the clock counts from targets in NumPy to a
configuration in NumPy. One robot: every peer in a process of its own on the same core, in turns. Many: batches of ours
with all cores, and in turns with them as many processes of each peer as there are cores; then each other batch, of ours
and of the peers that run batches. Gradients: ``benchmarks.rollouts``, of one step and of many. Pinocchio scores each
motion in float64; a fast wrong answer is marked as failed. ``--python`` names the interpreter of a peer that needs an
environment of its own. Beside the results comes a figure of throughput against the size of the batch.

Where Pinocchio is not installed, ``--workload`` takes a file that ``benchmarks.robots`` made elsewhere; motions are
kept beside the results, and ``--judge`` scores them later.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from osik_jax.runtime import configure_cpu

from . import figures, gradients, motions, report
from .command_line import listed
from .descriptions import ROBOTS
from .peers import BATCHED, PEERS
from .processes import Entrant, cores
from .race import Race
from .worker import JUDGED_LANES
from .workload import Workload

SCHEMES = ("weighted", "null-space", "hierarchical")
PRECISIONS = ("float64", "float32")
BATCHES = (1, 64, 1024, 16384)
PARTS = ("one", "many", "gradients")
COLD = ("weighted", "hierarchical")
"""Schemes that carry something from step to step, and are measured without it too."""
LONGEST = 5.0
"""[s] a step: a batch that would take more is left out."""


def ours(scheme: str, precision: str, *, pinned: bool = False, **options: Any) -> Entrant:
    """An entrant of this library."""
    shown = {key: value for key, value in options.items() if key == "batch"}
    parts = (scheme, precision, *(f"{key} {value}" for key, value in shown.items()))
    start = () if options.get("warm", True) else ("cold",)
    chosen = dict(scheme=scheme, precision=precision, **options)
    return Entrant(f"osik_jax, {', '.join([*parts, *start])}", "osik_jax", chosen, cores(1) if pinned else ())


@dataclasses.dataclass(frozen=True)
class Selection:
    """What a run is made of.

    Attributes:
        schemes, precisions, batches: of ours; the batches of peers too.
        peers: who takes part.
        parts: of ``PARTS``.
        cold: whether ours also runs without what it carries from step to step.
        resident: whether the configurations of all but a few robots of a batch stay on the device.
    """

    schemes: Sequence[str] = SCHEMES
    precisions: Sequence[str] = PRECISIONS
    batches: Sequence[int] = BATCHES
    peers: Sequence[str] = tuple(PEERS)
    parts: Sequence[str] = PARTS
    cold: bool = True
    resident: bool = False

    def others(
        self, pinned: tuple[int, ...], suffix: str = "", *, among: Sequence[str] = tuple(PEERS)
    ) -> list[Entrant]:
        """The peers that are not ours, one robot a process."""
        named = [name for name in self.peers if name != "osik_jax" and name in among]
        return [Entrant(name + suffix, name, cores=pinned) for name in named]

    def batched(self, batch: int) -> list[Entrant]:
        """The peers that run batches and are not ours."""
        options = self._options(batch)
        named = [name for name in self.peers if name != "osik_jax" and name in BATCHED]
        return [Entrant(f"{name}, batch {batch}", name, options) for name in named]

    def mine(self, batch: int | None = None, **options: Any) -> list[Entrant]:
        """Ours in all schemes and precisions."""
        if "osik_jax" not in self.peers:
            return []
        if batch is not None:
            options |= self._options(batch)
        if (batch or 1) > 1:
            options |= dict(devices=len(cores()))
        return [ours(scheme, precision, **options) for scheme in self.schemes for precision in self.precisions]

    def without_memory(self, **options: Any) -> list[Entrant]:
        """Ours as ``mine`` has it, starting from nothing in every step."""
        schemes = [scheme for scheme in self.schemes if scheme in COLD]
        return dataclasses.replace(self, schemes=schemes).mine(warm=False, **options) if self.cold else []

    def _options(self, batch: int) -> dict[str, Any]:
        return dict(batch=batch) | (dict(resident=JUDGED_LANES) if self.resident else {})


QUICK = Selection(schemes=SCHEMES[:1], precisions=PRECISIONS[:1], batches=(1024,), cold=False)


def one_robot(selection: Selection) -> list[Entrant]:
    """Everyone on one core."""
    return [*selection.others(cores(1)), *selection.mine(pinned=True), *selection.without_memory(pinned=True)]


def many_robots(selection: Selection) -> list[list[Entrant]]:
    """Runs: the first scheme's largest batch beside peers in several processes, then each other batch alone."""
    everywhere, largest = cores(), max(selection.batches)
    alone = [name for name in PEERS if name not in BATCHED]
    crowd = selection.others(everywhere, f", {len(everywhere)} processes", among=alone)
    groups = [[entrant] for batch in selection.batches for entrant in selection.mine(batch)]
    groups += [[entrant] for entrant in selection.without_memory(batch=largest)]
    groups += [[entrant] for batch in sorted(selection.batches) for entrant in selection.batched(batch)]
    beside = dataclasses.replace(selection, schemes=selection.schemes[:1]).mine(largest)
    return [[*crowd, *beside], *(group for group in groups if group[0] not in beside)]


def measure(race: Race, selection: Selection, *, quick: bool) -> dict[str, list[dict[str, Any]]]:
    """Rows of one robot, of many, and of gradients."""
    rounds, seconds = (5, 0.1) if quick else (10, 0.2)
    single: list[dict[str, Any]] = []
    many: list[dict[str, Any]] = []
    slopes: list[dict[str, Any]] = []
    if "one" in selection.parts:
        entrants = one_robot(selection)
        single = race.run(entrants, rounds=rounds, steps=200, seconds=seconds)
        for row in single:
            if row["peer"] in BATCHED:
                (entrant,) = [entrant for entrant in entrants if entrant.name == row["name"]]
                row["first_step_warm_seconds"] = race.again(entrant)
    if "many" in selection.parts:
        for group in many_robots(selection):
            many += race.run(affordable(group, many, race), rounds=rounds, steps=400, seconds=5 * seconds)
    if "gradients" in selection.parts and "osik_jax" in selection.peers:
        slopes = list(gradients.rows(race, selection.schemes, selection.precisions, quick=quick))
    return dict(one_robot=single, many_robots=many, gradients=slopes)


def affordable(group: list[Entrant], before: list[dict[str, Any]], race: Race) -> Iterator[Entrant]:
    """Those whose steps will not be too long, as their smaller batches tell."""
    for entrant in group:
        batch = entrant.options.get("batch", 1)
        alike = [
            row["step_seconds_median"] * batch / row["options"]["batch"]
            for row in before
            if row["peer"] == entrant.peer
            and row["options"] == dict(entrant.options) | dict(batch=row["options"].get("batch"))
        ]
        if alike and alike[-1] > LONGEST:
            race.report(f"{entrant.name} is left out: about {alike[-1]:.0f} s a step")
        else:
            yield entrant


def settings() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file; the figure is a .png beside it")
    parser.add_argument("--quick", action="store_true", help="about three minutes: one scheme and precision, few steps")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--parts", type=listed(str, PARTS), help=", ".join(PARTS))
    parser.add_argument("--peers", type=listed(str, PEERS), help=", ".join(PEERS))
    parser.add_argument("--schemes", type=listed(str, SCHEMES), help=", ".join(SCHEMES))
    parser.add_argument("--precisions", type=listed(str, PRECISIONS), help=", ".join(PRECISIONS))
    parser.add_argument("--batches", type=listed(int), help="sizes")
    parser.add_argument("--resident", action="store_true", help="batches stay on the device but for a few robots")
    parser.add_argument("--python", action="append", default=[], metavar="PEER=PATH", help="interpreter of a peer")
    parser.add_argument("--workload", type=Path, help="JSON file that benchmarks.robots wrote, in the place of --robot")
    parser.add_argument("--judge", action="store_true", help="score the motions of an earlier run, and show it")
    parser.add_argument("--gate", action="store_true", help="compare ours with benchmarks/baseline.json")
    parser.add_argument("--update", action="store_true", help="with --gate: write the baseline anew")
    given = parser.parse_args()
    if given.judge and given.results is None:
        parser.error("--judge needs the JSON file of the results")
    return given


def selected(given: argparse.Namespace) -> Selection:
    """What was asked for."""
    names = [field.name for field in dataclasses.fields(Selection)]
    chosen = {name: getattr(given, name) for name in names if getattr(given, name, None)}
    return dataclasses.replace(QUICK if given.quick else Selection(), **chosen)


def workload_of(given: argparse.Namespace) -> Workload:
    """Made by Pinocchio, or from a file."""
    if given.workload is not None:
        return Workload.from_json(given.workload.read_text(encoding="utf-8"))
    from .robots import workload

    return workload(given.robot)


def finish(console: Console, result: dict[str, Any], path: Path | None) -> int:
    """Writes and shows results; 1 where a motion of ours has failed."""
    if path is not None:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        figures.draw(result, path.with_suffix(".png"))
    report.show(console, result)
    return int(any(row["failures"] for row in motions.moving(result) if row["peer"] == "osik_jax"))


def main() -> int:
    """Prints tables; 1 where the gate fails or a motion of ours does."""
    given, console = settings(), Console(width=150)
    started = time.perf_counter()
    if given.judge:
        return finish(console, motions.judged_later(given.results), given.results)

    def tell(text: str) -> None:
        console.print(f"[dim]{time.perf_counter() - started:5.0f} s  {text}[/dim]")

    pythons = dict(pair.split("=", 1) for pair in given.python)
    work = workload_of(given)
    with Race(work, pythons=pythons, report=tell) as race:
        if given.gate:
            from . import gate

            return gate.check(race, console, update=given.update)
        rows = measure(race, selected(given), quick=given.quick)
    result = report.surroundings() | dict(
        command=shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
        robot=work.robot,
        seconds=time.perf_counter() - started,
        versions=race.versions,
        missing=race.missing,
        **rows,
    )
    judge = find_spec("pinocchio") is not None
    return finish(
        console, motions.judged(result, work) if judge else motions.kept(result, work, given.results), given.results
    )


if __name__ == "__main__":
    configure_cpu()
    sys.exit(main())
