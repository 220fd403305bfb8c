"""Steps a second of the closed loop against the size of the batch, on the default device.

    python -m benchmarks.throughput [results.json] [--robot nao] [--batches 1,64,1024] [--schemes weighted,...]
                                    [--precisions float64,float32] [--tasks polygon] [--steps 20]

The robot stands on both feet, keeps its centre of mass and reaches with one hand, each lane from other angles of its
arms and for another point; joint position and velocity limits, dt 5 ms. One call is one jitted, vmapped step: solve,
integrate, warm start carried on; with ``--steps`` so many, one after another. A call is timed alone and blocked until
ready; ``seconds`` is the median.

``error`` is the largest difference of any task's error [m or rad] to float64 on the CPU, in the first lanes, after the
same steps; ``solved`` the share of calls whose steps were all SOLVED. ``program_bytes`` is what XLA allots to the
program, with its arguments and results; ``device_peak_bytes`` the most that the device has held in this process, where
it says so. A sweep ends where a call would take too long or memory runs out. A results file keeps its other rows, so a
sweep may be run in parts.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from .command_line import listed
from .descriptions import ROBOTS, lean_urdf
from .device import device_bytes
from .machine import processor

TASKS = {
    "equality": "the centre of mass over one point",
    "polygon": "the centre of mass inside the support polygon (the paper's own set)",
    "limits": "polygon, and the velocity limits at half speed as a task",
    "cone": "polygon, and the hand's first axis within 30 degrees of a point ahead",
    "collision": "polygon, and the collision rows of the hand's arm as a task",
    "equality-far": "equality, with weights far apart",
    "polygon-far": "polygon, with weights far apart",
}
"""Task sets: what is added to feet, hand and posture. Sets with the polygon have inequality rows."""
WEIGHTS = {"near": (1e2, 10.0), "far": (1e4, 1e3)}
"""Weights of a foot and of the centre of mass; the hand has 1, the posture 1e-3."""
SCHEMES = {"weighted": osik.WeightedQP, "null-space": osik.NullSpace, "hierarchical": osik.HierarchicalQP}
PRECISIONS = ("float64", "float32")
BATCHES = (1, 16, 64, 256, 1024, 4096, 16384, 65536)
DT = 0.005
LANES = 64
"""Different situations; larger batches repeat them."""
CHECKED = 10
"""Calls after which errors are compared; they warm up too."""
TIMED = (5, 100)
"""Calls that are timed, at least and at most,"""
SECONDS = 5.0
"""for about so long."""
LONGEST = 20.0
"""[s] a call: a batch that would take more is left out."""


class Setting(NamedTuple):
    """A loop and the situations that it runs in, in one precision."""

    robot: osik.Robot
    tasks: dict[str, osik.Task]
    limits: tuple[osik.Limit, ...]
    starts: jax.Array
    targets: jax.Array


def setting(name: str, tasks_of: str = "equality") -> Setting:
    """Both feet, centre of mass, one hand's position, posture, and what ``TASKS`` adds; in JAX's default precision."""
    robot = loaded(name)
    feet, hand = ROBOTS[name].feet, ROBOTS[name].hand
    tasks_of, _, apart = tasks_of.partition("-")
    of_foot, of_center = WEIGHTS[apart or "near"]
    tasks: dict[str, osik.Task] = {foot: osik.FrameTask(robot, foot, weight=of_foot, priority=1) for foot in feet}
    if feet:
        stands = tasks_of != "equality"
        polygon = osik.support_polygon(robot, robot.q0, feet, corners=soles(name)) if stands else None
        tasks["com"] = osik.ComTask(robot, polygon=polygon, weight=of_center, priority=2)
    if tasks_of == "limits":
        slow = osik.VelocityLimit(robot, velocity=0.5 * robot.velocity_limit)
        tasks["limits"] = osik.LimitTask(robot, slow, priority=2)
    if tasks_of == "cone":
        axis, angle = (1.0, 0.0, 0.0), np.radians(30.0)
        tasks["cone"] = osik.LookAtTask(robot, hand, axis=axis, half_angle=angle, priority=2)
    if tasks_of == "collision":
        tasks["collision"] = osik.LimitTask(robot, osik.CollisionAvoidanceLimit(robot, max_pairs=4), priority=2)
    tasks["hand"] = osik.FrameTask(robot, hand, rows="position", priority=3)
    tasks["posture"] = osik.PostureTask(robot, weight=1e-3, gain=1.0, priority=4)
    starts, ends = (jnp.asarray(q) for q in arm_angles(robot, ROBOTS[name].arms))
    poses = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, hand)[0]))
    return Setting(robot, tasks, (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)), starts, poses(ends))


def soles(name: str) -> dict[str, tuple[tuple[float, float, float], ...]] | None:
    """The corners of the feet's contact areas; None where the robot's file has them."""
    robot = ROBOTS[name]
    return dict.fromkeys(robot.feet, robot.sole) if robot.sole else None


def loaded(name: str) -> osik.Robot:
    """An embedded robot, or one of example-robot-data, standing as in ``python -m benchmarks``."""
    given = ROBOTS[name]
    if not given.urdf:
        return osik.load_robot(name)
    robot = osik.Robot.from_urdf(lean_urdf(given), floating_base=bool(given.feet))
    q = np.array(robot.q0)
    q[[robot.joint_qpos_index(joint) for joint in given.posture]] = list(given.posture.values())
    kinematics = osik.forward_kinematics(robot, jnp.asarray(q))
    if given.feet:
        q[2] -= min(float(kinematics.frame_pose(robot, foot)[0][2]) for foot in given.feet)
    return replace(robot, q0=jnp.asarray(q))


def arm_angles(robot: osik.Robot, parts: tuple[str, ...]) -> np.ndarray:
    """Starts and ends (2, LANES, nq): joints of the arms up to a quarter of their range off home. Seed 0."""
    names = [name for name in robot.joint_names if any(part in name for part in parts)]
    dofs, places = ([index(name) for name in names] for index in (robot.joint_dof_index, robot.joint_qpos_index))
    low, high = np.asarray(robot.position_lower)[dofs], np.asarray(robot.position_upper)[dofs]
    q = np.tile(np.asarray(robot.q0), (2, LANES, 1))
    q[..., places] += 0.25 * (high - low) * np.random.default_rng(0).uniform(-1.0, 1.0, (2, LANES, len(names)))
    q[..., places] = np.clip(q[..., places], low, high)
    return q


class State(NamedTuple):
    """What is carried from step to step."""

    q: jax.Array
    warm_start: Any


def batch_of(
    given: Setting, scheme: osik.Scheme, batch: int, *, mapped: Callable[..., Any] = jax.vmap
) -> tuple[Any, tuple[Any, ...], State]:
    """The step mapped over lanes, its arguments before the state, and the first state."""
    lanes = np.arange(batch) % LANES
    tasks = osik.batched(given.tasks, {"hand.target[0]": given.targets[lanes]})
    axes = osik.batch_axes(given.tasks, "hand.target[0]")

    def solve(robot: Any, tasks: Any, scheme: Any, limits: Any, state: State) -> osik.Solution:
        q, warm_start = state
        return osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=DT, warm_start=warm_start)

    def step(robot: Any, tasks: Any, scheme: Any, limits: Any, state: State) -> tuple[State, Any, Any]:
        solution = solve(robot, tasks, scheme, limits, state)
        q = osik.integrate(robot, state.q, solution.velocity, DT)
        return State(q, solution.warm_start), solution.error, solution.status == osik.Status.SOLVED

    starts = given.starts[lanes]
    first = jax.eval_shape(
        lambda q: solve(given.robot, given.tasks, scheme, given.limits, State(q, None)).warm_start, given.starts[0]
    )
    none = jax.tree.map(lambda a: jnp.zeros((batch, *a.shape), a.dtype), first)
    arguments = (given.robot, tasks, scheme, given.limits)
    return mapped(step, in_axes=(None, axes, None, None, 0)), arguments, State(starts, none)


def compiled(function: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """The program, and the seconds that tracing and compiling took."""
    jax.clear_caches()
    started = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    return program, time.perf_counter() - started


def repeated(step: Callable[..., Any], steps: int) -> Callable[..., Any]:
    """So many steps one after another, with the error after the last and whether all were solved."""

    def many(*args: Any) -> Any:
        *given, state = args
        _, error, fine = jax.tree.map(lambda a: jnp.ones(a.shape, a.dtype), jax.eval_shape(step, *args))

        def again(_: Any, carry: Any) -> Any:
            state, error, solved = step(*given, carry[0])
            return state, error, solved & carry[2]

        return jax.lax.fori_loop(0, steps, again, (state, error, fine))

    return step if steps == 1 else many


@cache
def reference(robot: str, scheme: str, tasks: str = "equality", steps: int = 1) -> dict[str, np.ndarray]:
    """Task errors of all lanes after the checked calls, in float64 on the CPU."""
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        step, arguments, state = batch_of(setting(robot, tasks), SCHEMES[scheme](), LANES)
        program, _ = compiled(repeated(step, steps), *arguments, state)
        for _ in range(CHECKED):
            state, error, _ = program(*arguments, state)
        return {name: np.asarray(e) for name, e in error.items()}


def measure(
    given: Setting, scheme: osik.Scheme, batch: int, wanted: dict[str, np.ndarray], steps: int
) -> dict[str, Any]:
    """One row: how fast, how right, how much memory."""
    step, arguments, state = batch_of(given, scheme, batch)
    program, compile_seconds = compiled(repeated(step, steps), *arguments, state)
    solved: list[Any] = []
    seconds: list[float] = []
    errors: dict[str, float] = {}
    calls = CHECKED + TIMED[0]
    while len(solved) < calls:
        started = time.perf_counter()
        state, error, fine = jax.block_until_ready(program(*arguments, state))
        seconds.append(time.perf_counter() - started)
        solved.append(jnp.mean(fine))
        if len(solved) == CHECKED:
            calls += int(np.clip(SECONDS / min(seconds), *TIMED)) - TIMED[0]
            n = min(batch, LANES)
            errors = {name: float(np.abs(np.asarray(e)[:n] - wanted[name][:n]).max()) for name, e in error.items()}
    each = float(np.median(seconds[CHECKED:]))
    memory = program.memory_analysis()
    parts = ("argument_size_in_bytes", "output_size_in_bytes", "temp_size_in_bytes")
    return dict(
        batch=batch,
        steps=steps,
        seconds=each,
        steps_per_second=batch * steps / each,
        compile_seconds=compile_seconds,
        solved=float(np.mean(solved)),
        error=max(errors.values()),
        errors=errors,
        calls=calls - CHECKED,
        program_bytes=sum(int(getattr(memory, part, 0)) for part in parts),
        device_peak_bytes=device_bytes(),
    )


def sweep(
    robot: str, scheme: str, precision: str, batches: list[int], tasks: str = "equality", steps: int = 1
) -> Iterator[dict[str, Any]]:
    """Rows of growing batches, until a call would take too long or memory runs out."""
    label: dict[str, Any] = dict(robot=robot, scheme=scheme, precision=precision, tasks=tasks)
    last: dict[str, Any] | None = None
    wanted = reference(robot, scheme, tasks, steps)
    with jax.enable_x64(precision == "float64"):
        given = setting(robot, tasks)
        for batch in sorted(batches):
            if last and last["seconds"] * batch / last["batch"] > LONGEST:
                return
            try:
                last = label | measure(given, SCHEMES[scheme](), batch, wanted, steps)
            except jax.errors.JaxRuntimeError as failure:
                if "RESOURCE_EXHAUSTED" not in str(failure):
                    raise
                return
            yield last


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    device = jax.devices()[0]
    return dict(device=device.device_kind, platform=device.platform, cpu=processor(), jax=jax.__version__)


def kept(path: Path | None) -> list[dict[str, Any]]:
    """Rows of an earlier run.

    Raises:
        ValueError: they are from another machine.
    """
    if path is None or not path.exists():
        return []
    before = json.loads(path.read_text())
    here = machine()
    if any(before[key] != here[key] for key in here):
        raise ValueError(f"{path} is from another machine or release: name another file for {here}")
    return before["rows"]


def identity(row: dict[str, Any]) -> tuple[Any, ...]:
    """What a row is of."""
    of_call = row["batch"], row.get("tasks", "equality"), row.get("steps", 1)
    return row["robot"], row["scheme"], row["precision"], *of_call


def show(rows: list[dict[str, Any]]) -> None:
    """A table; lines of JSON where rich is not installed."""
    try:
        from rich.console import Console
        from rich.table import Table
    except ImportError:
        for row in rows:
            print(json.dumps(row))
        return
    heads = "scheme, tasks, precision, batch, steps, ms a call, steps/s, solved, error, compile [s], MiB"
    table = Table(*heads.split(", "))
    for r in rows:
        table.add_row(
            *(r["scheme"], r.get("tasks", "equality"), r["precision"], f"{r['batch']:,}", f"{r.get('steps', 1)}"),
            *(f"{1e3 * r['seconds']:.3g}", f"{r['steps_per_second']:,.0f}", f"{r['solved']:.4f}", f"{r['error']:.1e}"),
            *(f"{r['compile_seconds']:.1f}", f"{r['program_bytes'] / 2**20:.2g}"),
        )
    Console(width=110).print(table)


def main() -> None:
    """Prints each row as it comes and a table at the end, and writes the rows to the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.throughput", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--robot", default="nao", choices=sorted(ROBOTS))
    parser.add_argument("--batches", type=listed(int), default=list(BATCHES))
    parser.add_argument("--schemes", type=listed(str, SCHEMES), default=list(SCHEMES))
    parser.add_argument("--precisions", type=listed(str, PRECISIONS), default=list(PRECISIONS))
    parser.add_argument(
        "--tasks", type=listed(str, TASKS), default=["equality", "polygon", "polygon-far"], help=", ".join(TASKS)
    )
    parser.add_argument("--steps", type=int, default=1, help="of a call, one after another on the device")
    given = parser.parse_args()
    if given.steps < 1:
        parser.error(f"--steps is {given.steps}; a call has one or more")
    jax.config.update("jax_enable_x64", True)
    rows, new = {identity(row): row for row in kept(given.results)}, []
    for scheme in given.schemes:
        for precision in given.precisions:
            swept = (sweep(given.robot, scheme, precision, given.batches, tasks, given.steps) for tasks in given.tasks)
            for row in chain.from_iterable(swept):
                print(json.dumps(row), flush=True)
                rows[identity(row)] = row
                new.append(row)
                if given.results is not None:
                    given.results.write_text(json.dumps(machine() | dict(rows=list(rows.values())), indent=1) + "\n")
    show(new)


if __name__ == "__main__":
    configure_cpu()
    main()
