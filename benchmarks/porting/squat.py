"""pink's example humanoid_g1_com: a G1 squats by moving its centre of mass, from straight and from bent knees."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pink
import pinocchio as pin

import osik_jax as osik

from .g1 import DT, FEET, G1, HANDS

STEPS = 800
HEIGHT, STROKE, PERIOD = 0.55, 0.05, 2.0
"""Of the centre of mass [m, m, s]."""
OFFSET = np.array([-0.1, 0.0, -0.2])
"""Of the hands' targets from where the hands are at the start [m]."""
DAMPING = 0.01


def report() -> Iterator[str]:
    """A row for each start and each way to solve; the last half of the motion, unless said otherwise."""
    g1 = G1()
    yield (
        "knees at the start | solved by | steps with a joint at its speed limit [%] | joint speed, rms [rad/s] | "
        "feet off [mm] | centre of mass off [mm] | knees, least and most [rad] | apart from pink, at most [rad] | at "
        "the end [rad]"
    )
    for bend in (0.0, 0.2):
        q = g1.standing(0.72, bend)
        q[2] += _lift(g1, q)
        motions = {
            "pink, quadprog": _in_pink(g1, q, "quadprog"),
            "pink, daqp": _in_pink(g1, q, "daqp"),
            "osik-jax, as pink": _in_osik(g1, q, "se3", 0.5, 0.0),
            "osik-jax, its own error and limit": _in_osik(g1, q, "decoupled", 1.0, 0.0),
            "osik-jax, defaults": _in_osik(g1, q, "decoupled", 1.0, 1.0),
        }
        reference = motions["pink, quadprog"]
        for name, motion in motions.items():
            yield " | ".join([f"{2.0 * bend} rad", name, *_measured(g1, q, motion, reference)])


def _lift(g1: G1, q: np.ndarray) -> float:
    """How much higher the base has to be for the feet to stay where those of the straight legs are [m]."""
    straight = g1.poses(g1.standing(0.72, 0.0), FEET)[FEET[0]].translation[2]
    return float(straight - g1.poses(q, FEET)[FEET[0]].translation[2])


def com_at(k: int) -> np.ndarray:
    """Target of the centre of mass at step k."""
    return np.array([0.0, 0.0, HEIGHT + STROKE * np.sin(2.0 * np.pi / PERIOD * k * DT)])


def _targets(g1: G1, q: np.ndarray) -> dict[str, pin.SE3]:
    poses = g1.poses(q, ("pelvis", *FEET, *HANDS))
    for hand in HANDS:
        poses[hand].translation += OFFSET
    return poses


def _in_pink(g1: G1, start: np.ndarray, solver: str) -> np.ndarray:
    configuration = pink.Configuration(g1.model, g1.model.createData(), start.copy())
    costs = {"pelvis": (0.0, 10.0)} | dict.fromkeys(FEET, (200.0, 10.0)) | dict.fromkeys(HANDS, (4.0, 0.0))
    poses = _targets(g1, start)
    com, posture = pink.tasks.ComTask(200.0), pink.tasks.PostureTask(0.1)
    posture.set_target(start)
    tasks: list[Any] = [com, posture]
    for frame, cost in costs.items():
        tasks.append(pink.tasks.FrameTask(frame, *cost))
        tasks[-1].set_target(poses[frame])
    path = [start]
    for k in range(STEPS):
        com.set_target(com_at(k))
        v = pink.solve_ik(configuration, tasks, DT, solver=solver, damping=DAMPING, safety_break=False)
        configuration.integrate_inplace(v, DT)
        path.append(configuration.q.copy())
    return np.array(path)


def _in_osik(g1: G1, start: np.ndarray, error: Any, limit_gain: float, curvature: float) -> np.ndarray:
    robot, gain, poses = g1.robot, 1.0 / DT, _targets(g1, start)
    shared: dict[str, Any] = dict(gain=gain, error=error)
    whole: dict[str, Any] = dict(position_weight=200.0**2, orientation_weight=10.0**2, **shared)
    point: dict[str, Any] = dict(rows="position", weight=4.0**2, **shared)
    tasks: dict[str, osik.Task] = {
        "pelvis": osik.FrameTask(
            robot, "pelvis", target=poses["pelvis"], rows="orientation", orientation_weight=100.0, **shared
        ),
        "com": osik.ComTask(robot, weight=200.0**2, gain=gain),
        "posture": osik.PostureTask(robot, target=g1.configuration(start), weight=0.01, gain=gain),
        **{foot: osik.FrameTask(robot, foot, target=poses[foot], **whole) for foot in FEET},
        **{hand: osik.FrameTask(robot, hand, target=poses[hand], **point) for hand in HANDS},
    }
    path = osik.rollout(
        robot,
        jnp.asarray(g1.configuration(start)),
        tasks,
        scheme=osik.WeightedQP(damping=DAMPING, curvature_damping=curvature),
        limits=(osik.ConfigurationLimit(robot, gain=limit_gain), osik.VelocityLimit(robot)),
        dt=DT,
        steps=STEPS,
        targets={"com": np.array([com_at(k) for k in range(STEPS)])},
    )
    return np.array([g1.pinocchio_configuration(q) for q in jax.device_get(path.q)])


def _measured(g1: G1, start: np.ndarray, motion: np.ndarray, reference: np.ndarray) -> list[str]:
    model, targets, late = g1.model, _targets(g1, start), STEPS // 2
    speeds = np.array([pin.difference(model, a, b)[6:] / DT for a, b in pairwise(motion)])[late:]
    at_limit = (np.abs(speeds) > 0.999 * model.velocityLimit[6:]).any(axis=1)
    feet = [
        np.linalg.norm(pose.translation - targets[foot].translation)
        for q in motion[late + 1 :]
        for foot, pose in g1.poses(q, FEET).items()
    ]
    com = [np.linalg.norm(g1.com(q) - com_at(k)) for k, q in enumerate(motion[late + 1 :], late)]
    knees = motion[late:, g1.knees]
    apart = np.abs(motion - reference)[:, 7:].max(axis=1)
    return [
        f"{100.0 * at_limit.mean():.0f}",
        f"{np.sqrt(np.mean(speeds**2)):.2f}",
        f"{1e3 * max(feet):.2f}",
        f"{1e3 * max(com):.2f}",
        f"{knees.min():.3f} to {knees.max():.3f}",
        f"{apart.max():.1e}",
        f"{apart[-1]:.1e}",
    ]
