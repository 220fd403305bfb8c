"""Hard work by us and by the peers that are installed: targets out of reach, targets that jump, a stretch, a squat.

    python -m benchmarks.hard [results.json] [--all] [--only TEXT] [--python placo=PATH] [--times] [--write]
    python -m benchmarks.hard --film [film.gif]
    python -m benchmarks.hard --settling
    python -m benchmarks.hard --balance

Pinocchio judges every motion from its configurations alone; docs/hard_work.md says what is asked and what each number
is. Without ``--all`` it is a selection that takes some minutes. ``--only`` takes those whose names, such as
"g1, hierarchy, float64, no posture", hold a text. Rows that the file of results has already are not made again.
``--write`` writes the page's table and docs/data/hard_work.csv. ``--times`` prints the time of a step too (only
on a machine with nothing else to do). ``--film`` films a G1 of ours beside mink's, with a target that is out of reach.
``--settling`` runs targets out of reach for 16 s, and writes docs/data/settling.csv. ``--balance`` prints how far feet
give way to such a target where the weights balance.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import jax
from rich.console import Console

from osik_jax.runtime import configure_cpu

from ..data_file import write_csv
from ..processes import PeerUnavailable
from ..robots import workload
from ._balance import balances
from ._cases import cases
from ._film import FILM, film
from ._motion import Entrant
from ._page import FILE, PAGE, SETTLING, tables, write
from ._results import ROBOTS, Row, entrants, keep, read, rows
from ._settling import settling


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.hard", description=(__doc__ or "").split("\n")[0])
    made.add_argument("results", nargs="?", type=Path, help="JSON file; what it has is not made again")
    made.add_argument("--all", action="store_true", help="every scheme in both precisions")
    made.add_argument("--only", default="", metavar="TEXT", help="part of the names of those that are wanted")
    made.add_argument("--python", action="append", default=[], metavar="PEER=PATH", help="interpreter of a peer")
    made.add_argument("--times", action="store_true", help="with the time of a step")
    made.add_argument("--write", action="store_true", help=f"write {PAGE.name} and {FILE.name}")
    made.add_argument("--film", nargs="?", type=Path, const=FILM, help=f"only the film, by default {FILM.name}")
    made.add_argument("--settling", action="store_true", help="only the table of speeds over 16 s")
    made.add_argument("--balance", action="store_true", help="only where the weights of feet and hand balance")
    return made


def measure(given: argparse.Namespace, console: Console) -> list[Row]:
    """The rows of the file and those that it lacks, which go into the file as they come; by entrant."""
    found = read(given.results)
    done: set[Entrant] = {row.entrant for row in found}
    missing: set[str] = set()
    wanted = [one for one in entrants(everything=given.all, only=given.only) if one not in done]
    for robot in ROBOTS:
        own = [one for one in wanted if one.robot == robot]
        work = workload(robot) if own else None
        asked = cases(work) if work else []
        for one in own:
            if work is None or one.solver in missing:
                continue
            try:
                found += rows(one, work, asked, dict(pair.split("=", 1) for pair in given.python))
            except PeerUnavailable as reason:
                missing.add(one.solver)
                console.print(f"{one.solver} is left out: {reason}")
                continue
            console.print(str(one))
            keep(given.results, found)
        jax.clear_caches()
    order = entrants(everything=True)
    return sorted(found, key=lambda row: order.index(row.entrant))


def main() -> None:
    """Measures, prints, and writes where asked to."""
    given, console = parser().parse_args(), Console(width=200)
    logging.disable(logging.WARNING)  # pink and mink tell of every joint at a limit
    if given.film:
        film(given.film)
        return
    if given.settling:
        head, *lines = settling()
        write_csv(SETTLING, head, lines)
        return
    if given.balance:
        print("\n".join(map(" | ".join, balances())))
        return
    found = measure(given, console)
    if given.write:
        write(found)
    for name, text in tables(found, times=given.times).items():
        print(f"\n{name}\n\n{text}")


if __name__ == "__main__":
    configure_cpu()
    main()
