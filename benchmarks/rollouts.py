"""What the gradient through rollouts costs: over weights that all robots share and the target of each.

    python -m benchmarks.rollouts [results.json] [--robot g1] [--robots 64] [--steps 100] [--scheme weighted]
                                  [--precision float64]

The setting is that of ``benchmarks.throughput``, closed loop, on the default device. The loss is the mean over robots
of the hand's squared error in the steps, and of its squared distance to the target where the last step led.
``forward`` is the loss alone, ``gradient`` both.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from .descriptions import ROBOTS
from .device import device_bytes
from .machine import peak_bytes
from .throughput import DT, LANES, PRECISIONS, SCHEMES, compiled, machine, setting

CALLS = 5
"""Timed calls of each, after one that does not count."""


def measure(robot: str, scheme: str, robots: int, steps: int) -> list[dict[str, Any]]:
    """A row of the loss, and one of the loss with its gradient."""
    given = setting(robot)
    hand = given.tasks["hand"]
    assert isinstance(hand, osik.FrameTask)
    lanes = np.arange(robots) % LANES
    starts, points = given.starts[lanes], given.targets[lanes]

    def path(q: jax.Array, point: jax.Array, tasks: dict[str, osik.Task]) -> jax.Array:
        aimed = tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        run = osik.rollout(given.robot, q, aimed, scheme=SCHEMES[scheme](), limits=given.limits, dt=DT, steps=steps)
        end, _ = osik.forward_kinematics(given.robot, run.q[-1]).frame_pose(given.robot, hand.frame)
        return jnp.mean(run.solution.error["hand"] ** 2) + jnp.sum((end - point) ** 2)

    def loss(weights: dict[str, jax.Array], points: jax.Array) -> jax.Array:
        tasks = {name: task.replace(weight=weights[name]) for name, task in given.tasks.items()}
        return jnp.mean(jax.vmap(path, in_axes=(0, 0, None))(starts, points, tasks))

    at = {name: task.weight for name, task in given.tasks.items()}, points
    rows = []
    for name, function in (("forward", loss), ("gradient", jax.value_and_grad(loss, argnums=(0, 1)))):
        program, compile_seconds = compiled(function, *at)
        seconds = []
        for _ in range(CALLS + 1):
            started = time.perf_counter()
            out = jax.block_until_ready(program(*at))
            seconds.append(time.perf_counter() - started)
        fine = bool(jax.tree.reduce(lambda ok, leaf: ok & bool(jnp.isfinite(leaf).all()), out, True))
        memory = getattr(program.memory_analysis(), "temp_size_in_bytes", 0)
        each = float(np.median(seconds[1:]))
        rows.append(
            dict(part=name, seconds=each, compile_seconds=compile_seconds, finite=fine, temporary_bytes=int(memory))
        )
    return rows


def main() -> None:
    """Prints a table, and writes a file where one is named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rollouts", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--scheme", default="weighted", choices=sorted(SCHEMES))
    parser.add_argument("--precision", default="float64", choices=PRECISIONS)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    rows = measure(given.robot, given.scheme, given.robots, given.steps)
    if given.results is not None:
        asked = {key: value for key, value in vars(given).items() if key != "results"}
        memory = dict(peak_bytes=peak_bytes(), device_peak_bytes=device_bytes())
        result = machine() | asked | memory | dict(rows=rows)
        given.results.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    table = Table("part", "ms", "times forward", "steps/s", "finite", "compile [s]", "temporary [MiB]")
    for row in rows:
        each = row["seconds"]
        table.add_row(
            *(row["part"], f"{1e3 * each:,.1f}", f"{each / rows[0]['seconds']:.2f}"),
            *(f"{given.robots * given.steps / each:,.0f}", str(row["finite"]), f"{row['compile_seconds']:.1f}"),
            f"{row['temporary_bytes'] / 2**20:,.1f}",
        )
    Console(width=110).print(table)


if __name__ == "__main__":
    configure_cpu()
    main()
