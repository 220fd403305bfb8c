"""Collision avoidance: a Unitree G1 reaches for points in and around itself; what meets, and what avoiding it costs.

    python -m benchmarks.collision [results.json] [--motions 10000] [--steps 40] [--batch 250] [--calls 30]

The robot stands on both feet, keeps its centre of mass and sends each hand to a random point of a box around its body,
in front of a table: many points are out of reach, inside a link or inside the table. Steps of 20 ms, joint position
limits, joint speeds of at most 5 rad/s, the weighted scheme in float64. Each configuration of each motion is judged by
Pinocchio's kinematics and coal's distances. The same motions without the limit tell how many would have met something.

``without`` and ``with`` are medians of the time of a step: solve and integrate, warm start carried on, one robot or a
batch, the first motions' steps one after the other.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import coal
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
from rich.console import Console
from rich.progress import track
from rich.table import Table

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from .capsules import G1, Capsule, shapes
from .descriptions import ROBOTS, lean_urdf
from .robots import pinocchio_model
from .throughput import loaded, machine

DT = 0.02
SPEED = 5.0
"""Greatest joint speed [rad/s]."""
MINIMUM_DISTANCE = 0.02
HANDS = ("left_rubber_hand", "right_rubber_hand")
REACH = np.array([[-0.15, -0.45, 0.25], [0.5, 0.45, 1.3]])
"""Where the hands' targets are [m]."""
TABLE = (np.array([0.25, 0.5, 0.02]), np.array([0.6, 0.0, 0.75]))
"""Half sizes and centre [m]."""
BATCHES = (1, 1024)


class Setting(NamedTuple):
    """What a step is made of; the last limit avoids collisions."""

    robot: osik.Robot
    tasks: dict[str, osik.Task]
    limits: tuple[osik.Limit, ...]

    def limits_for(self, avoiding: bool) -> tuple[osik.Limit, ...]:
        """With or without the avoidance of collisions."""
        return self.limits if avoiding else self.limits[:-1]


def setting() -> Setting:
    """The robot, its tasks and limits."""
    robot = loaded("g1")
    tasks: dict[str, osik.Task] = {
        foot: osik.FrameTask(robot, foot, weight=100.0, gain=10.0) for foot in ROBOTS["g1"].feet
    }
    tasks["com"] = osik.ComTask(robot, weight=10.0, gain=5.0, axes="xy")
    tasks |= {hand: osik.FrameTask(robot, hand, rows="position", gain=5.0) for hand in HANDS}
    tasks["posture"] = osik.PostureTask(robot, weight=1e-2, gain=1.0)
    half_sizes, centre = TABLE
    avoidance = osik.CollisionAvoidanceLimit(
        robot,
        shapes=shapes(G1) | {"table": osik.CollisionShape.box(half_sizes, centre)},
        minimum_distance=MINIMUM_DISTANCE,
    )
    speeds = osik.VelocityLimit(robot, velocity={"*": SPEED})
    return Setting(robot, tasks, (osik.ConfigurationLimit(robot), speeds, avoidance))


def targets(motions: int) -> np.ndarray:
    """Of both hands [m], seed 0. (motions, 2, 3)."""
    return np.random.default_rng(0).uniform(REACH[0], REACH[1], (motions, 2, 3))


def aimed(given: Setting, points: Any) -> dict[str, osik.Task]:
    """The tasks with the hands' targets (2, 3)."""
    out = dict(given.tasks)
    for hand, point in zip(HANDS, points, strict=True):
        task = out[hand]
        assert isinstance(task, osik.FrameTask)
        out[hand] = task.replace(target=(point, jnp.eye(3)))
    return out


class Judge:
    """Pinocchio's kinematics and coal's distances, of the pairs that the limit keeps apart."""

    def __init__(self, robot: osik.Robot, capsules: dict[str, Capsule], pairs: tuple[tuple[str, str], ...]):
        self.model = pinocchio_model(lean_urdf(ROBOTS["g1"]), True)
        self.data = self.model.createData()
        self.places = [self.model.joints[self.model.getJointId(name)].idx_q for name in robot.joint_names]
        self.own = [robot.joint_qpos_index(name) for name in robot.joint_names]
        self.shapes = pin.GeometryModel()
        ids = {name: self._add(name, capsule) for name, capsule in capsules.items()}
        half_sizes, centre = TABLE
        table = pin.GeometryObject("table", 0, pin.SE3(np.eye(3), centre), coal.Box(*(2.0 * half_sizes)))
        ids["table"] = self.shapes.addGeometryObject(table)
        for a, b in pairs:
            self.shapes.addCollisionPair(pin.CollisionPair(ids[a], ids[b]))
        self.shape_data = self.shapes.createData()
        for request in self.shape_data.distanceRequests:
            request.enable_signed_distance = True

    def _add(self, name: str, capsule: Capsule) -> int:
        frame = self.model.frames[self.model.getFrameId(capsule.link)]
        start, end = np.array(capsule.start), np.array(capsule.end)
        along = end - start
        length = float(np.linalg.norm(along))
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along / length).matrix()
        place = frame.placement * pin.SE3(turn, 0.5 * (start + end))
        shape = coal.Capsule(capsule.radius, length)
        return self.shapes.addGeometryObject(
            pin.GeometryObject(name, frame.parentJoint, frame.parentFrame, place, shape)
        )

    def distance(self, q: np.ndarray) -> float:
        """The smallest of all pairs at one of our configurations [m]."""
        own = np.empty(self.model.nq)
        own[:3], own[3:7] = q[:3], q[[4, 5, 6, 3]]
        own[self.places] = q[self.own]
        pin.computeDistances(self.model, self.data, self.shapes, self.shape_data, own)
        return min(result.min_distance for result in self.shape_data.distanceResults)


def run_motions(given: Setting, points: np.ndarray, steps: int, batch: int, avoiding: bool) -> dict[str, np.ndarray]:
    """Configurations, statuses and the hands' last errors of all motions, and how many programs were compiled."""
    traced = []

    @jax.jit
    def run(points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        def one(points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            out = osik.rollout(
                given.robot,
                given.robot.q0,
                aimed(given, points),
                scheme=osik.WeightedQP(damping=1e-4),
                limits=given.limits_for(avoiding),
                dt=DT,
                steps=steps,
            )
            errors = [jnp.linalg.norm(out.solution.error[hand][-1]) for hand in HANDS]
            return out.q, out.solution.status, jnp.stack(errors)

        traced.append(points.shape)
        return jax.vmap(one)(points)

    starts = range(0, len(points), batch)
    parts = [jax.tree.map(np.asarray, run(points[k : k + batch])) for k in track(starts, "motions")]
    q, status, errors = (np.concatenate(part) for part in zip(*parts, strict=True))
    return dict(q=q, status=status, errors=errors, programs=np.array(len(traced)))


def judged(given: Setting, run: dict[str, np.ndarray]) -> dict[str, Any]:
    """What met in some motions."""
    avoidance = given.limits[-1]
    assert isinstance(avoidance, osik.CollisionAvoidanceLimit)
    judge = Judge(given.robot, G1, avoidance.pairs)
    least = np.array([min(judge.distance(q) for q in motion) for motion in track(run["q"], "judge")])
    infeasible = run["status"] == osik.Status.INFEASIBLE
    return dict(
        motions=len(least),
        steps=run["status"].shape[1],
        penetrations=int((least < 0.0).sum()),
        below_minimum=int((least < MINIMUM_DISTANCE).sum()),
        smallest_distance=float(least.min()),
        infeasible_steps=float(infeasible.mean()),
        other_failures=float(((run["status"] != osik.Status.SOLVED) & ~infeasible).mean()),
        reached=float((run["errors"] < 0.01).mean()),
        programs=int(run["programs"]),
    )


def step_seconds(given: Setting, points: np.ndarray, batch: int, avoiding: bool, calls: int) -> dict[str, float]:
    """Median of the time of a step, and the time that compiling took [s]."""

    def step(q: jax.Array, warm_start: Any, points: jax.Array) -> tuple[jax.Array, Any]:
        solution = osik.solve(
            given.robot,
            q,
            aimed(given, points),
            scheme=osik.WeightedQP(damping=1e-4),
            limits=given.limits_for(avoiding),
            dt=DT,
            warm_start=warm_start,
        )
        return osik.integrate(given.robot, q, solution.velocity, DT), solution.warm_start

    one = step if batch == 1 else jax.vmap(step)
    points = points[0] if batch == 1 else points[np.arange(batch) % len(points)]
    q = given.robot.q0 if batch == 1 else jnp.tile(given.robot.q0, (batch, 1))
    cold = jax.tree.map(
        lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(lambda q, p: one(q, None, p)[1], q, points)
    )
    started = time.perf_counter()
    program = jax.jit(one).lower(q, cold, points).compile()
    compile_seconds, state, seconds = time.perf_counter() - started, (q, cold), []
    for _ in range(calls + 1):
        started = time.perf_counter()
        state = jax.block_until_ready(program(*state, points))
        seconds.append(time.perf_counter() - started)
    return dict(seconds=float(np.median(seconds[1:])), compile_seconds=compile_seconds)


def main() -> None:
    """Prints two tables, and writes a file where one is named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.collision", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("results", nargs="?", type=Path, help="JSON file")
    parser.add_argument("--motions", type=int, default=10000)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--batch", type=int, default=250, help="motions at once; divides --motions")
    parser.add_argument("--free", type=int, default=500, help="motions that are run without the limit too")
    parser.add_argument("--calls", type=int, default=60, help="of a step, timed; 0: none")
    asked = parser.parse_args()
    if asked.motions % asked.batch or asked.free % asked.batch:
        parser.error("--batch has to divide --motions and --free")
    jax.config.update("jax_enable_x64", True)
    given, points = setting(), targets(asked.motions)
    avoidance = given.limits[-1]
    assert isinstance(avoidance, osik.CollisionAvoidanceLimit)
    counts = dict(pairs=len(avoidance.pairs), rows=avoidance.max_pairs, shapes=len(G1) + 1)
    costs = [
        dict(batch=batch, avoiding=avoiding, **step_seconds(given, points, batch, avoiding, asked.calls))
        for batch, avoiding in itertools.product(BATCHES, (False, True))
        if asked.calls
    ]
    show_costs(costs, counts)
    motions = {
        name: judged(given, run_motions(given, some, asked.steps, asked.batch, avoiding))
        for name, some, avoiding in (("without", points[: asked.free], False), ("with", points, True))
    }
    show_motions(motions)
    if asked.results is not None:
        out = machine() | counts | dict(motions=motions, costs=costs)
        asked.results.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


def show_costs(costs: list[dict[str, Any]], counts: dict[str, int]) -> None:
    """Time of a step."""
    table = Table("batch", "avoiding", "step [us]", "us a robot", "compile [s]", title=str(counts))
    for row in costs:
        each = 1e6 * row["seconds"]
        table.add_row(
            *(str(row["batch"]), str(row["avoiding"]), f"{each:,.0f}"),
            *(f"{each / row['batch']:,.1f}", f"{row['compile_seconds']:.1f}"),
        )
    Console(width=110).print(table)


def show_motions(motions: dict[str, dict[str, Any]]) -> None:
    """What met."""
    table = Table("", *motions)
    for key in next(iter(motions.values())):
        table.add_row(key, *(f"{row[key]:.6g}" for row in motions.values()))
    Console(width=110).print(table)


if __name__ == "__main__":
    configure_cpu()
    main()
