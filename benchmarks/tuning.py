"""Tuning by gradient beside CMA-ES: the same loop, scenarios, start and space, the same number of rollouts.

    python -m benchmarks.tuning [results.json]
    python -m benchmarks.tuning --memory [steps] [scenarios]      peak of one gradient; default 1000 and 256

NAO stands on both feet and reaches with both hands for points that its arms can reach. All weights and gains start at
the library's defaults, 1 and 10 / s. Training and held-out scenarios are drawn apart; neither method sees the second.
CMA-ES gets the same number of rollouts, and then also what the gradients cost in time, three rollouts each.
"""

from __future__ import annotations

import fnmatch
import json
import resource
import sys
import time
from functools import partial
from typing import Any, NamedTuple

import cma
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import osik_jax as osik
from osik_jax import tuning
from osik_jax.runtime import configure_cpu
from osik_jax.tuning._losses import LossFunction
from osik_jax.tuning._parameters import ParameterSpace
from osik_jax.tuning._tune import Tuning

FEET = {"left_foot": "l_sole", "right_foot": "r_sole"}
HANDS = {"left_hand": "l_gripper", "right_hand": "r_gripper"}
COST_OF_A_GRADIENT = 3
"""In rollouts."""
FAILED = 1e9
"""What CMA-ES is told where no scenario can be kept."""


class Experiment(NamedTuple):
    """What is tuned, on what, and by what it is judged."""

    loss: LossFunction
    parameters: list[str | tuning.Parameter]
    loop: tuning.Loop
    training: tuning.Scenarios
    held_out: tuning.Scenarios


def nao_reaching(*, training: int = 32, held_out: int = 32, steps: int = 75, dt: float = 0.02) -> Experiment:
    """NAO reaches with both hands, feet flat, centre of mass over them; 15 parameters."""
    robot = osik.load_robot("nao")
    polygon = osik.support_polygon(robot, robot.q0, tuple(FEET.values()))
    tasks: dict[str, osik.Task] = {
        name: osik.FrameTask(robot, sole, orientation_weight=1.0) for name, sole in FEET.items()
    }
    tasks["com"] = osik.ComTask(robot, polygon=osik.support_polygon(robot, robot.q0, tuple(FEET.values()), margin=0.02))
    tasks["torso"] = osik.FrameTask(robot, "torso", rows="orientation", orientation_weight=1.0)
    tasks |= {name: osik.FrameTask(robot, hand, rows="position") for name, hand in HANDS.items()}
    tasks["posture"] = osik.PostureTask(robot, weight=1.0)
    loop = loop_of(robot, tasks, dt, steps)
    loss = (
        tuning.Tracking(*HANDS, after=0.5 * steps * dt)
        + 10.0 * tuning.Tracking(*FEET)
        + tuning.ComMargin(polygon, margin=0.01)
        + 1e-6 * tuning.Smoothness()
    )
    both = reachable(robot, ("[LR]Shoulder*", "[LR]Elbow*"), HANDS, training + held_out)
    return Experiment(loss, parameters(tasks, dt), loop, both[:training], both[training:])


def arm_reaching(*, training: int = 8, held_out: int = 8, steps: int = 30, dt: float = 0.04) -> Experiment:
    """The arm reaches with its hand while its elbow and its posture would rather stay; 11 parameters."""
    robot = osik.load_robot("arm7")
    tasks = {
        "hand": osik.FrameTask(robot, "hand", rows="position", gain=osik.AdaptiveGain(10.0, 5.0, 1.0)),
        "wrist": osik.FrameTask(robot, "hand", rows="orientation", orientation_weight=1.0),
        "elbow": osik.FrameTask(robot, "link4", rows="position"),
        "posture": osik.PostureTask(robot, weight=1.0),
    }
    loop = loop_of(robot, tasks, dt, steps)
    loss = tuning.Tracking("hand", after=0.5 * steps * dt) + 1e-6 * tuning.Smoothness()
    both = reachable(robot, ("*",), {"hand": "hand"}, training + held_out, spread=0.3)

    return Experiment(loss, parameters(tasks, dt), loop, both[:training], both[training:])


def loop_of(robot: osik.Robot, tasks: dict[str, osik.Task], dt: float, steps: int) -> tuning.Loop:
    """The closed loop that is tuned: weighted tasks inside joint position and velocity limits."""
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)
    return tuning.Loop(robot, tasks, scheme=osik.WeightedQP(damping=1e-6), limits=limits, dt=dt, steps=steps)


def parameters(tasks: dict[str, osik.Task], dt: float) -> list[str | tuning.Parameter]:
    """All weights, gains up to where a step still goes the right way only, and the damping."""
    return [
        *(tuning.Parameter(f"{name}.weight", lower=1e-4, upper=1e4) for name in tasks),
        *(tuning.Parameter(f"{name}.gain", lower=0.1, upper=0.9 / dt) for name in tasks),
        tuning.Parameter("scheme.damping", lower=1e-10, upper=1.0),
    ]


def reachable(
    robot: osik.Robot, joints: tuple[str, ...], hands: dict[str, str], count: int, *, spread: float = 0.25
) -> tuning.Scenarios:
    """Starts and targets from random joint angles around home, by a share of each joint's range. Seed 0."""
    names = [name for name in robot.joint_names if any(fnmatch.fnmatchcase(name, joint) for joint in joints)]
    dofs = np.array([robot.joint_dof_index(name) for name in names])
    places = np.array([robot.joint_qpos_index(name) for name in names])
    low, high = np.asarray(robot.position_lower)[dofs], np.asarray(robot.position_upper)[dofs]
    random = np.random.default_rng(0)

    def draw() -> np.ndarray:
        q = np.tile(np.asarray(robot.q0), (count, 1))
        q[:, places] += spread * (high - low) * random.uniform(-1.0, 1.0, (count, len(dofs)))
        q[:, places] = np.clip(q[:, places], low + 0.02 * (high - low), high - 0.02 * (high - low))
        return q

    start, end = draw(), draw()
    at = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_poses(robot, tuple(hands.values()))[0]))
    points = at(end)
    return tuning.Scenarios(q0=start, values={f"{name}.target[0]": points[:, i] for i, name in enumerate(hands)})


def by_gradient(experiment: Experiment, iterations: int, **options: Any) -> Tuning:
    """``tune`` with its defaults."""
    loss, names, loop, training, held_out = experiment
    return tuning.tune(loss, names, training, loop=loop, held_out=held_out, iterations=iterations, **options)


def by_cma(
    experiment: Experiment, evaluations: int, *, sigma: float = 0.5, seed: int = 1
) -> tuple[np.ndarray, tuning.Loop]:
    """CMA-ES from the same start in the same space: the best training loss after each evaluation, and the best loop."""
    loss, names, loop, training, _ = experiment
    space = ParameterSpace(loop, names)
    search = cma.CMAEvolutionStrategy(np.asarray(space.initial), sigma, {"seed": seed, "verbose": -9})
    best, found, curve = np.inf, loop, []
    while len(curve) < evaluations:
        asked, costs = search.ask(), []
        for vector in asked:
            tried = space.apply(loop, jnp.asarray(vector))
            costs.append(float(jnp.nan_to_num(tuning.evaluate(loss, tried, training).loss, nan=FAILED)))
            if len(curve) < evaluations:
                best, found = (costs[-1], tried) if costs[-1] < best else (best, found)
                curve.append(best)
        search.tell(asked, costs)
    return np.array(curve), found


def compare(
    experiment: Experiment,
    iterations: int = 100,
    *,
    seeds: int = 3,
    costs: tuple[int, ...] = (1, COST_OF_A_GRADIENT),
    **options: Any,
) -> dict[str, Any]:
    """Held-out losses before and after, by gradient and by CMA-ES: medians over seeds.

    Args:
        experiment: what is tuned.
        iterations: gradients over the training scenarios.
        seeds: runs of CMA-ES for each cost.
        costs: rollouts that CMA-ES gets for each of the gradient's.
        options: of ``tune``.
    """
    loss, _, loop, training, held_out = experiment
    judge = partial(tuning.evaluate, loss, scenarios=held_out)
    before = float(judge(loop).loss)
    started = time.perf_counter()
    tuned = by_gradient(experiment, iterations, **options)
    seconds = time.perf_counter() - started
    out: dict[str, Any] = {
        "parameters": len(tuned.space.names),
        "training": len(training),
        "before": before,
        "gradient": {
            "rollouts": iterations * len(training),
            "training_loss": tuned.loss,
            "held_out_loss": tuned.held_out,
            "seconds": seconds,
            "curve": np.minimum.accumulate(tuned.history.loss).tolist(),
        },
        "tuned": tuned.parameters,
    }
    for cost in costs:
        started, evaluations = time.perf_counter(), cost * iterations
        runs = [by_cma(experiment, evaluations, seed=seed + 1) for seed in range(seeds)]
        judged = [float(judge(found).loss) for _, found in runs]
        out["cma" if cost == 1 else f"cma x {cost}"] = {
            "rollouts": evaluations * len(training),
            "training_loss": float(np.median([curve[-1] for curve, _ in runs])),
            "held_out_loss": float(np.median(judged)),
            "best_held_out_loss": min(judged),
            "seconds": (time.perf_counter() - started) / seeds,
            "curve": np.median([curve for curve, _ in runs], 0).tolist(),
        }
    return out


def peak_memory(steps: int = 1000, scenarios: int = 256, *, chunk: int = 64) -> float:
    """GiB that the whole process held at most, after one gradient on NAO; to be asked in a process of its own."""
    experiment = nao_reaching(training=scenarios, held_out=1, steps=steps, dt=0.005)
    loss, names, loop, training, _ = experiment
    tuning.tune(loss, names, training, loop=loop, iterations=1, chunk=chunk, progress=False)
    unit = 2**30 if sys.platform == "darwin" else 2**20  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def report_memory(steps: int = 1000, scenarios: int = 256) -> None:
    """Prints the peak, and how long it took."""
    started = time.perf_counter()
    peak = peak_memory(steps, scenarios)
    seconds = time.perf_counter() - started
    print(f"gradient of {steps} steps x {scenarios} scenarios of NAO: {peak:.2f} GiB at most, {seconds:.0f} s in all")


def main(path: str | None = None) -> None:
    """Prints a table, and writes all numbers as JSON."""
    jax.config.update("jax_enable_x64", True)
    result = compare(nao_reaching())
    table = Table("method", "rollouts", "training loss", "held-out loss", "times lower", "seconds")
    table.add_row("defaults", "", "", f"{result['before']:.3e}", "1", "")
    for label in ("gradient", *(label for label in result if label.startswith("cma"))):
        row = result[label]
        table.add_row(
            label,
            str(row["rollouts"]),
            f"{row['training_loss']:.3e}",
            f"{row['held_out_loss']:.3e}",
            f"{result['before'] / row['held_out_loss']:.1f}",
            f"{row['seconds']:.0f}",
        )
    Console().print(table)
    if path:
        with open(path, "w") as file:
            json.dump(result, file, indent=1)


if __name__ == "__main__":
    configure_cpu()
    if sys.argv[1:2] == ["--memory"]:
        jax.config.update("jax_enable_x64", True)
        report_memory(*map(int, sys.argv[2:4]))
    else:
        main(*sys.argv[1:2])
