"""Where a step's time goes: its parts alone, each a program of its own, and the operations that take most of it.

    python -m benchmarks.parts [results.json] [--robot g1] [--batches 1,1024] [--scheme weighted] [--precision float64]
                               [--operations 20]

The setting is that of ``benchmarks.throughput``, each lane with its own active set known. ``dispatch`` is a program
that adds 1 to the configuration; ``rows`` are those of all tasks; ``gradient`` is that of the squared velocity with
respect to the configuration and the hand's target, with the velocity. A batch of 1 has no batch axis. Parts do not add
up: each pays for its dispatch and its results. Kinematics and rows are a step's, by kernels where there are some.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import osik_jax as osik
from osik_jax.kinematics._forward import kinematics_by
from osik_jax.runtime import configure_cpu
from osik_jax.tasks._rows import rows_of

from .command_line import listed
from .descriptions import ROBOTS
from .throughput import DT, LANES, PRECISIONS, SCHEMES, Setting, compiled, machine, setting

SECONDS = 1.0
"""That the calls of one part take, about."""
CALLS = (10, 300)
"""Calls of one part, at least and at most."""
NO_OPERATIONS = ("parameter", "get-tuple-element", "tuple", "bitcast", "constant")
"""What XLA's text lists and nothing runs."""


def parts(given: Setting, scheme: osik.Scheme) -> tuple[dict[str, Callable[..., Any]], tuple[Any, ...]]:
    """Functions of a configuration, the hand's target and a warm start, and those of all lanes."""
    robot, tasks, limits = given.robot, given.tasks, given.limits
    hand = tasks["hand"]
    assert isinstance(hand, osik.FrameTask)

    def solve(q: jax.Array, point: jax.Array, warm_start: Any = None) -> osik.Solution:
        aimed = tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        return osik.solve(robot, q, aimed, scheme=scheme, limits=limits, dt=DT, warm_start=warm_start)

    def step(q: jax.Array, point: jax.Array, warm_start: Any) -> tuple[jax.Array, Any, jax.Array]:
        solution = solve(q, point, warm_start)
        return osik.integrate(robot, q, solution.velocity, DT), solution.warm_start, solution.status

    def speed(q: jax.Array, point: jax.Array, warm_start: Any) -> jax.Array:
        return jnp.sum(solve(q, point, warm_start).velocity ** 2)

    functions = {
        "dispatch": lambda q, *_: q + 1.0,
        "forward kinematics": lambda q, *_: kinematics_by("auto", robot, q),
        "rows": lambda q, *_: rows_of(robot, kinematics_by("auto", robot, q), q, tasks),
        "step": step,
        "gradient": jax.value_and_grad(speed, argnums=(0, 1)),
    }
    warm_starts = jax.jit(jax.vmap(lambda *situation: solve(*situation).warm_start))(given.starts, given.targets)
    return functions, (given.starts, given.targets, warm_starts)


def median_seconds(program: Callable[..., Any], *args: Any) -> float:
    """Of a call, blocked until ready, after one that does not count."""
    jax.block_until_ready(program(*args))
    seconds: list[float] = []
    while len(seconds) < CALLS[0] or (sum(seconds) < SECONDS and len(seconds) < CALLS[1]):
        started = time.perf_counter()
        jax.block_until_ready(program(*args))
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))


def operations_of(text: str) -> int:
    """Operations of a program's main computation; a loop counts as one."""
    names = re.findall(r"= .*? ([a-z\-]+)\(", text[text.index("ENTRY") :])
    return sum(name not in NO_OPERATIONS for name in names)


def profiled(program: Any, args: tuple[Any, ...], most: int, calls: int = 20) -> list[tuple[str, float]]:
    """The operations that take longest, as XLA names them and where they come from, and seconds a call.

    A loop counts its body, whose operations are listed too. Tracing adds a good part of a microsecond to each.
    """
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(calls):
                jax.block_until_ready(program(*args))
        (record,) = Path(folder).rglob("*.xplane.pb")
        for plane in jax.profiler.ProfileData.from_file(str(record)).planes:
            for line in plane.lines:
                for event in line.events:
                    name = dict(event.stats).get("hlo_op")
                    if name:
                        total[str(name)] += event.duration_ns
    origin = dict(re.findall(r'%([\w.\-]+) = .*?op_name="([^"]*)"', program.as_text()))
    return [(f"{name}  {origin.get(name, '')[-70:]}", 1e-9 * ns / calls) for name, ns in total.most_common(most)]


def measure(given: Setting, scheme: str, batch: int, operations: int) -> list[dict[str, Any]]:
    """A row for each part."""
    functions, situations = parts(given, SCHEMES[scheme]())
    lanes = 0 if batch == 1 else np.arange(batch) % LANES
    args = jax.tree.map(lambda a: a[lanes], situations)
    rows = []
    for name, function in functions.items():
        program, compile_seconds = compiled(function if batch == 1 else jax.vmap(function), *args)
        row = dict(part=name, batch=batch, seconds=median_seconds(program, *args), compile_seconds=compile_seconds)
        slowest = profiled(program, args, operations) if operations and name == "step" else []
        rows.append(row | dict(operations=operations_of(program.as_text() or ""), slowest=slowest))
    return rows


def show(console: Console, rows: list[dict[str, Any]]) -> None:
    """A table of the parts, and one of the slowest operations where they were asked for."""
    table = Table("part", "robots", "µs a call", "µs a robot", "operations", "traced and compiled [s]")
    for row in rows:
        each = 1e6 * row["seconds"]
        table.add_row(
            *(row["part"], f"{row['batch']:,}", f"{each:,.1f}", f"{each / row['batch']:.3g}"),
            *(str(row["operations"]), f"{row['compile_seconds']:.1f}"),
        )
    console.print(table)
    for row in rows:
        for name, seconds in row["slowest"]:
            console.print(f"{row['batch']:6,} {1e6 * seconds:10,.1f} µs  {name}", highlight=False, markup=False)


def main() -> None:
    """Prints the tables, and writes a file where one is named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.parts", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--batches", type=listed(int), default=[1, 1024])
    parser.add_argument("--scheme", default="weighted", choices=sorted(SCHEMES))
    parser.add_argument("--precision", default="float64", choices=PRECISIONS)
    parser.add_argument("--operations", type=int, default=0, help="list so many of the slowest of the step")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    chosen, rows = setting(given.robot), []
    for batch in given.batches:
        rows += measure(chosen, given.scheme, batch, given.operations)
    if given.results is not None:
        asked = dict(robot=given.robot, scheme=given.scheme, precision=given.precision)
        given.results.write_text(json.dumps(machine() | asked | dict(rows=rows), indent=1) + "\n", encoding="utf-8")
    show(Console(width=150), rows)


if __name__ == "__main__":
    configure_cpu()
    main()
