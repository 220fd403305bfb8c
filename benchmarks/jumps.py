"""Millions of steps towards targets that jump, in one batch on the default device: what fails, and how fast it goes.

    python -m benchmarks.jumps [results.json] [--robot g1] [--scheme weighted] [--robots 16384] [--scans 20]
                               [--precision float32] [--radius 0.5] [--tasks polygon] [--sample sample.npz]
    python -m benchmarks.jumps --judge sample.npz

The task sets are those of ``benchmarks.throughput``; the default is the paper's own. A scan is 50 steps of 5 ms with
the warm start carried on; before each, every hand gets a new target, uniform in a ball of the radius around its place
at home, so that many are out of reach and none is led up to. The first scan compiles and is not timed, its statuses
count. With ``--radius 0.02`` it is easy work, to be held against.

``--sample`` keeps configurations, targets and answers of single steps, each the first one after a jump. ``--judge``
solves those that were SOLVED again in double precision, from the same numbers.
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
from .throughput import DT, PRECISIONS, TASKS, Setting, State, batch_of, machine, setting

SCHEMES = {**throughput.SCHEMES, "saturated": lambda: osik.NullSpace(method="saturated")}
STEPS = 50
RADIUS = {"nao": 0.25, "g1": 0.5, "arm7": 0.5}
"""Of the balls that suit a robot [m]."""


KEPT = ("q", "target", "velocity", "status")
"""What a sample has of each step."""
QUANTILES = dict(median=0.5, of_999=0.999, largest=1.0)
SAMPLE = 100_000
"""Steps that are kept, about."""


def measure(
    given: Setting,
    scheme: osik.Scheme,
    robots: int,
    scans: int,
    radius: float,
    sample: list[list[np.ndarray]] | None = None,
) -> dict[str, Any]:
    """Shares of statuses, the worst that a step did, and steps a second; single steps go into the sample."""
    robot, (*_, state) = given.robot, batch_of(given, scheme, robots)
    hand = given.tasks["hand"]
    assert isinstance(hand, osik.FrameTask)
    home, _ = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, hand.frame)

    def solved(state: State, point: jax.Array) -> osik.Solution:
        tasks = given.tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        return osik.solve(robot, state.q, tasks, scheme=scheme, limits=given.limits, dt=DT, warm_start=state.warm_start)

    def step(state: State, point: jax.Array) -> tuple[State, Any]:
        s = solved(state, point)
        seen = s.status, jnp.max(jnp.abs(s.velocity)), s.box_violation, s.iterations, jnp.isfinite(s.velocity).all()
        return State(osik.integrate(robot, state.q, s.velocity, DT), s.warm_start), seen

    @jax.jit
    def scan(state: State, points: jax.Array) -> tuple[State, Any]:
        def all_robots(state: State, _: None) -> tuple[State, Any]:
            state, (status, speed, beyond, iterations, finite) = jax.vmap(step)(state, points)
            count = jnp.sum(status[:, None] == jnp.array(list(osik.Status)), 0)
            return state, (count, speed.max(), beyond.max(), iterations.mean(), iterations.max(), finite.all())

        return jax.lax.scan(all_robots, state, length=STEPS)

    look = jax.jit(jax.vmap(solved))
    kept = np.arange(min(robots, -(-SAMPLE // (scans + 1))))
    rng, seconds, seen = np.random.default_rng(0), [], []
    for _ in range(scans + 1):
        points = jnp.asarray(np.asarray(home) + in_ball(rng, robots, radius), home.dtype)
        if sample is not None:
            first = jax.tree.map(lambda a: a[kept], state)
            found = look(first, points[kept])
            sample.append([np.asarray(a) for a in (first.q, points[kept], found.velocity, found.status)])
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


def compared(given: Setting, scheme: osik.Scheme, sample: dict[str, np.ndarray]) -> dict[str, float]:
    """How far answers are from those in double precision; the setting and the scheme are in double precision.

    ``rows`` is the largest difference of a weighted row of a task, as a share of the largest that is asked for, and
    ``cost`` by how much the weighted sum of squares is larger, as a share of that of standing still.
    """
    hand = given.tasks["hand"]
    assert isinstance(hand, osik.FrameTask)

    @jax.jit
    @jax.vmap
    def one(q: jax.Array, point: jax.Array, velocity: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        tasks = given.tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        exact = osik.solve(given.robot, q, tasks, scheme=scheme, limits=given.limits, dt=DT)
        rows = osik.build_problem(given.robot, q, tasks, limits=given.limits, dt=DT).rows.values()
        A = jnp.concatenate([r.weight[:, None] ** 0.5 * r.jacobian for r in rows])
        b = jnp.concatenate([r.weight**0.5 * r.lower for r in rows])
        far = jnp.max(jnp.abs(A @ (velocity - exact.velocity))) / jnp.max(jnp.abs(b))
        costs = [jnp.sum((A @ v - b) ** 2) for v in (velocity, exact.velocity)]
        return far, (costs[0] - costs[1]) / jnp.sum(b**2), exact.status

    usable = sample["status"] == osik.Status.SOLVED
    parts = [np.asarray(sample[name][usable], float) for name in ("q", "target", "velocity")]
    far, more, status = (np.asarray(a) for a in one(*parts))
    also = status == osik.Status.SOLVED
    figures = {f"rows_{name}": float(np.quantile(far[also], share)) for name, share in QUANTILES.items()}
    figures |= {f"cost_{name}": float(np.quantile(more[also], share)) for name, share in QUANTILES.items()}
    return dict(steps=len(usable), solved=int(usable.sum()), in_double_too=int(also.sum())) | figures


def joined(sample: list[list[np.ndarray]]) -> dict[str, np.ndarray]:
    """The single steps of all scans as one array of each kind."""
    return {name: np.concatenate([parts[i] for parts in sample]) for i, name in enumerate(KEPT)}


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
    parser.add_argument("--tasks", default="polygon", choices=sorted(TASKS))
    parser.add_argument("--precision", default="float32", choices=PRECISIONS)
    parser.add_argument("--radius", type=float, help="of the balls [m]; default 0.5, NAO 0.25")
    parser.add_argument("--sample", type=Path, help="file for single steps")
    parser.add_argument("--judge", type=Path, help="only judge a sample, of the same robot and scheme")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64" or given.judge is not None)
    radius = RADIUS.get(given.robot, 0.5) if given.radius is None else given.radius
    sample: list[list[np.ndarray]] = []
    if given.judge is not None:
        with np.load(given.judge) as file:
            row = compared(setting(given.robot, given.tasks), SCHEMES[given.scheme](), dict(file))
    else:
        kept = sample if given.sample else None
        row = measure(
            setting(given.robot, given.tasks), SCHEMES[given.scheme](), given.robots, given.scans, radius, kept
        )
        if given.sample:
            np.savez(given.sample, allow_pickle=False, **joined(sample))
    if given.results is not None:
        files = ("results", "sample", "judge")
        asked = {key: value for key, value in vars(given).items() if key not in files} | dict(radius=radius)
        given.results.write_text(json.dumps(machine() | asked | row, indent=1) + "\n", encoding="utf-8")
    table = Table("what", "value")
    for name, value in row.items():
        table.add_row(name, f"{value:,.4g}" if isinstance(value, float) else str(value))
    Console(width=110).print(table)


if __name__ == "__main__":
    configure_cpu()
    main()
