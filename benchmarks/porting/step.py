"""One step of a G1 beside pink: how far apart the velocities are, by the form of the error and the limit's gain."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
import pink
import pinocchio as pin

import osik_jax as osik

from .g1 import DT, FEET, G1, HANDS

CASES = 16
DISTANCES = ((0.01, 0.05), (0.05, 0.3), (0.15, 1.0))
"""How far the hands' targets are: up to [m] along each axis, up to [rad] about each."""
FORMS = (("decoupled", 1.0), ("decoupled", 0.5), ("se3", 1.0), ("se3", 0.5))
GAINS = (0.1, 1.0)
"""pink's, of a step: at 1 joints come to their limits."""


def report() -> Iterator[str]:
    """A row for each distance and kind of hand task."""
    g1 = G1()
    yield f"{CASES} steps of a G1: greatest difference of a velocity from pink's, % of the fastest, median"
    yield " | ".join(["gain", "hands", "within", *(f"{error}, gain of the limit {gain}" for error, gain in FORMS)])
    for gain in GAINS:
        for turned in (True, False):
            for distance in DISTANCES:
                apart = [_apart(g1, np.random.default_rng(k), distance, turned, gain) for k in range(CASES)]
                shown = [f"{100.0 * share:.2g}" for share in np.median(apart, axis=0)]
                kind = "pose" if turned else "position"
                yield " | ".join([str(gain), kind, f"{distance[0]} m, {distance[1]} rad", *shown])


def _apart(g1: G1, rng: np.random.Generator, distance: tuple[float, float], turned: bool, gain: float) -> list[float]:
    """Of one random case, for each form."""
    home = g1.standing(0.75, 0.35)
    lower, upper = g1.model.lowerPositionLimit[7:], g1.model.upperPositionLimit[7:]
    q = home.copy()
    q[7:] = np.clip(q[7:] + rng.uniform(-0.3, 0.3, len(lower)), lower + 0.05, upper - 0.05)
    poses, targets = g1.poses(q, (*FEET, *HANDS)), {}
    for frame, pose in poses.items():
        far, wide = distance if frame in HANDS else (0.002, 0.005)
        offset = np.concatenate([rng.uniform(-far, far, 3), rng.uniform(-wide, wide, 3)])
        targets[frame] = pose * pin.exp6(offset)
    com = g1.com(q) + rng.uniform(-0.01, 0.01, 3)
    expected = _in_pink(g1, q, targets, com, home, turned, gain)
    answers = [_in_osik(g1, q, targets, com, home, turned, gain, *form) for form in FORMS]
    return [float(np.abs(v - expected).max() / np.abs(expected).max()) for v in answers]


def _in_pink(
    g1: G1, q: np.ndarray, targets: dict[str, pin.SE3], com: np.ndarray, home: np.ndarray, turned: bool, gain: float
) -> np.ndarray:
    configuration = pink.Configuration(g1.model, g1.model.createData(), q)
    tasks: list[Any] = []
    for frame, pose in targets.items():
        position, orientation = (10.0, 10.0) if frame in FEET else (2.0, 0.5 if turned else 0.0)
        tasks.append(pink.tasks.FrameTask(frame, position, orientation, gain=gain))
        tasks[-1].set_target(pose)
    tasks += [pink.tasks.ComTask(5.0, gain=gain), pink.tasks.PostureTask(0.05, gain=gain)]
    tasks[-2].set_target(com)
    tasks[-1].set_target(home)
    return g1.velocity(pink.solve_ik(configuration, tasks, DT, solver="quadprog", damping=1e-9), q)


def _in_osik(
    g1: G1,
    q: np.ndarray,
    targets: dict[str, pin.SE3],
    com: np.ndarray,
    home: np.ndarray,
    turned: bool,
    step_gain: float,
    error: Any,
    limit_gain: float,
) -> np.ndarray:
    robot, gain = g1.robot, step_gain / DT
    tasks: dict[str, osik.Task] = {
        "com": osik.ComTask(robot, target=com, weight=25.0, gain=gain),
        "posture": osik.PostureTask(robot, target=g1.configuration(home), weight=0.0025, gain=gain),
    }
    for frame, pose in targets.items():
        options: dict[str, Any] = dict(target=pose, error=error, gain=gain)
        if frame in FEET:
            tasks[frame] = osik.FrameTask(robot, frame, weight=100.0, orientation_weight=1.0, **options)
        elif turned:
            tasks[frame] = osik.FrameTask(robot, frame, position_weight=4.0, orientation_weight=0.25, **options)
        else:
            tasks[frame] = osik.FrameTask(robot, frame, rows="position", weight=4.0, **options)
    scheme = osik.WeightedQP(damping=1e-9, curvature_damping=0.0)
    limits = osik.ConfigurationLimit(robot, gain=limit_gain), osik.VelocityLimit(robot)
    answer = osik.solve(robot, jnp.asarray(g1.configuration(q)), tasks, scheme=scheme, limits=limits, dt=DT)
    return np.asarray(answer.velocity)
