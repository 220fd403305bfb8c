"""Weak scaling: steps a second of the closed loop on 1, 2, 4, ... devices, with as many lanes on each.

    python -m benchmarks.scaling [results.json] [--robot nao] [--scheme weighted] [--precision float32] [--lanes 16384]
                                 [--devices 1,2,4]

The setting is that of ``benchmarks.throughput``; the batch is split by ``osik_jax.scaling.sharded``, the state of each
lane stays on its device and its memory is given to the next. ``efficiency`` is steps a second and device, over that of
the first row. ``error`` is the largest difference of any task's error [m or rad] to float64 on one CPU device, over all
lanes, after the same steps.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from osik_jax.runtime import configure_cpu
from osik_jax.scaling import sharded

from .command_line import listed
from .descriptions import ROBOTS
from .throughput import (
    CHECKED,
    LANES,
    PRECISIONS,
    SCHEMES,
    SECONDS,
    TIMED,
    Setting,
    batch_of,
    machine,
    reference,
    setting,
)

HALF_A_MINUTE = 30.0
"""[s] of one row, at most, whatever ``TIMED`` asks for."""


def measure(given: Setting, scheme: str, devices: int, lanes: int, wanted: dict[str, np.ndarray]) -> dict[str, Any]:
    """One row: so many devices, with so many lanes on each."""
    mapped = partial(sharded, mesh=jax.sharding.Mesh(jax.devices()[:devices], ("lanes",)))
    step, arguments, first = batch_of(given, SCHEMES[scheme](), devices * lanes, mapped=mapped)
    *arguments, state = step.place(*arguments, first)
    step = jax.jit(step, donate_argnums=4)
    solved: list[float] = []
    seconds: list[float] = []
    worst, calls = np.inf, CHECKED + TIMED[0]
    while len(solved) < calls and (len(solved) <= CHECKED or sum(seconds[1:]) < HALF_A_MINUTE):
        started = time.perf_counter()
        state, error, fine = jax.block_until_ready(step(*arguments, state))
        seconds.append(time.perf_counter() - started)
        solved.append(float(np.mean(fine)))
        if len(solved) == CHECKED:
            calls += int(np.clip(SECONDS / min(seconds), *TIMED)) - TIMED[0]
            own = np.arange(devices * lanes) % LANES
            worst = max(float(np.abs(np.asarray(e) - wanted[name][own]).max()) for name, e in error.items())
    each = float(np.median(seconds[CHECKED:]))
    return dict(
        devices=devices,
        lanes_per_device=lanes,
        seconds=each,
        steps_per_second=devices * lanes / each,
        first_call_seconds=seconds[0],
        solved=float(np.mean(solved)),
        error=worst,
        calls=len(solved) - CHECKED,
    )


def powers(count: int) -> list[int]:
    """1, 2, 4, ... up to a number of devices."""
    return [2**k for k in range(count.bit_length())]


def run(robot: str, scheme: str, precision: str, lanes: int, devices: list[int]) -> Iterator[dict[str, Any]]:
    """Rows, each with its efficiency beside the first one."""
    there = len(jax.devices())
    if max(devices) > there or min(devices) < 1:
        raise ValueError(f"devices {devices}, but there are {there}")
    wanted = reference(robot, scheme)
    with jax.enable_x64(precision == "float64"):
        given, alone = setting(robot), None
        for count in devices:
            row = measure(given, scheme, count, lanes, wanted)
            each = row["steps_per_second"] / count
            alone = alone or each
            yield dict(robot=robot, scheme=scheme, precision=precision) | row | dict(efficiency=each / alone)


def show(rows: list[dict[str, Any]]) -> None:
    """A table, in plain text."""
    heads = ("devices", "lanes each", "ms a call", "steps/s", "efficiency", "solved", "error", "first call [s]")
    print("  ".join(f"{head:>14}" for head in heads))
    for r in rows:
        cells = (
            *(f"{r['devices']}", f"{r['lanes_per_device']:,}", f"{1e3 * r['seconds']:.3g}"),
            *(f"{r['steps_per_second']:,.0f}", f"{r['efficiency']:.3f}", f"{r['solved']:.4f}", f"{r['error']:.1e}"),
            f"{r['first_call_seconds']:.1f}",
        )
        print("  ".join(f"{cell:>14}" for cell in cells))


def main() -> None:
    """Prints each row as it comes and a table at the end, and writes the rows to the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--robot", default="nao", choices=sorted(ROBOTS))
    parser.add_argument("--scheme", default="weighted", choices=sorted(SCHEMES))
    parser.add_argument("--precision", default="float32", choices=PRECISIONS)
    parser.add_argument("--lanes", type=int, default=16384, help="on each device")
    parser.add_argument("--devices", type=listed(int), help="numbers of devices; default: powers of two")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    devices = given.devices or powers(len(jax.devices()))
    for row in run(given.robot, given.scheme, given.precision, given.lanes, devices):
        print(json.dumps(row), flush=True)
        rows.append(row)
        if given.results is not None:
            given.results.write_text(json.dumps(machine() | dict(rows=rows), indent=1) + "\n")
    show(rows)


if __name__ == "__main__":
    configure_cpu()
    main()
