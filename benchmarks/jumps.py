"""Millions of steps towards targets that jump, in one batch on the default device: what fails, and how fast it goes.

    python -m benchmarks.jumps [results.json] [--robot g1] [--scheme weighted] [--robots 16384] [--scans 20]
                               [--precision float32] [--radius 0.5]

The tasks are those of ``benchmarks.throughput``. A scan is 50 steps of 5 ms with the warm start carried on; before
each, every hand gets a new target, uniform in a ball of the radius around its place at home, so that many are out of
reach and none is led up to. The first scan compiles and is not timed, its statuses count. With ``--radius 0.02`` it is
easy work, to be held against.
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

from . import throughput
from .descriptions import ROBOTS
from .throughput import DT, PRECISIONS, Setting, State, batch_of, machine, setting

SCHEMES = {**throughput.SCHEMES, "saturated": lambda: osik.NullSpace(method="saturated")}
STEPS = 50
RADIUS = {"nao": 0.25, "g1": 0.5, "arm7": 0.5}
"""Of the balls that suit a robot [m]."""


def measure(given: Setting, scheme: osik.Scheme, robots: int, scans: int, radius: float) -> dict[str, Any]:
    """Shares of statuses, the worst that a step did, and steps a second."""
    robot, (*_, state) = given.robot, batch_of(given, scheme, robots)
    hand = given.tasks["hand"]
    assert isinstance(hand, osik.FrameTask)
    home, _ = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, hand.frame)

    def step(state: State, point: jax.Array) -> tuple[State, Any]:
        tasks = given.tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        s = osik.solve(robot, state.q, tasks, scheme=scheme, limits=given.limits, dt=DT, warm_start=state.warm_start)
        seen = s.status, jnp.max(jnp.abs(s.velocity)), s.box_violation, s.iterations, jnp.isfinite(s.velocity).all()
        return State(osik.integrate(robot, state.q, s.velocity, DT), s.warm_start), seen

    @jax.jit
    def scan(state: State, points: jax.Array) -> tuple[State, Any]:
        def tick(state: State, _: None) -> tuple[State, Any]:
            state, (status, speed, beyond, iterations, finite) = jax.vmap(step)(state, points)
            count = jnp.sum(status[:, None] == jnp.array(list(osik.Status)), 0)
            return state, (count, speed.max(), beyond.max(), iterations.mean(), iterations.max(), finite.all())

        return jax.lax.scan(tick, state, length=STEPS)

    rng, seconds, seen = np.random.default_rng(0), [], []
    for _ in range(scans + 1):
        points = jnp.asarray(np.asarray(home) + in_ball(rng, robots, radius), home.dtype)
        started = time.perf_counter()
        state, found = jax.block_until_ready(scan(state, points))
        seconds.append(time.perf_counter() - started)
        seen.append(jax.tree.map(np.asarray, found))
    counts, speed, beyond, mean, most, finite = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return dict(
        steps=int(counts.sum()),
        statuses={status.name: int(n) for status, n in zip(osik.Status, counts.sum(0), strict=True)},
        finite=bool(finite.all()),
        beyond_limits=float(beyond.max()),
        fastest=float(speed.max()),
        iterations=float(mean.mean()),
        most_iterations=int(most.max()),
        steps_per_second=robots * STEPS / float(np.median(seconds[1:])),
        first_seconds=seconds[0],
    )


def in_ball(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    """Uniform in a ball around 0, (count, 3)."""
    away = rng.normal(size=(count, 3))
    return away * (radius * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True))


def main() -> None:
    """Prints a table, and writes a file where one is named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.jumps", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--robot", default="g1", choices=sorted(ROBOTS))
    parser.add_argument("--scheme", default="weighted", choices=sorted(SCHEMES))
    parser.add_argument("--robots", type=int, default=16384)
    parser.add_argument("--scans", type=int, default=20, help="that are timed")
    parser.add_argument("--precision", default="float32", choices=PRECISIONS)
    parser.add_argument("--radius", type=float, help="of the balls [m]; default 0.5, NAO 0.25")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    radius = RADIUS.get(given.robot, 0.5) if given.radius is None else given.radius
    row = measure(setting(given.robot), SCHEMES[given.scheme](), given.robots, given.scans, radius)
    if given.results is not None:
        asked = {key: value for key, value in vars(given).items() if key != "results"} | dict(radius=radius)
        given.results.write_text(json.dumps(machine() | asked | row, indent=1) + "\n", encoding="utf-8")
    table = Table("what", "value")
    for name, value in row.items():
        table.add_row(name, f"{value:,.4g}" if isinstance(value, float) else str(value))
    Console(width=110).print(table)


if __name__ == "__main__":
    configure_cpu()
    main()
