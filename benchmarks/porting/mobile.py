"""mink's example mobile_tidybot with its base held by a damping task: an arm on wheels, its target near and far."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mink
import mujoco
import numpy as np
from jaxtyping import Array

import osik_jax as osik

DT = 0.005
STEPS = 400
ITERATIONS = 20
"""Steps towards each target, as in the example; fewer where the hand is at its target."""
THRESHOLD = 1e-4
DAMPING = 1e-3
START = np.array([0.0, 0.0, 0.0, 0.0, 0.6, 0.0, 1.4, 0.0, 0.8, 0.0])
LINKS = (
    ("0 0 1", 0.492, 0.0),
    ("0 1 0", 0.128, 2.24),
    ("0 0 1", 0.21, 0.0),
    ("0 1 0", 0.21, 2.57),
    ("0 0 1", 0.208, 0.0),
    ("0 1 0", 0.106, 2.09),
    ("0 0 1", 0.106, 0.0),
)
"""Of each joint of the arm: axis, height over the one before [m], range to either side [rad], 0 for none."""
Where = Literal["near", "far"]


def model_text() -> str:
    """The robot as MJCF: a planar base, and seven joints of which every other one may turn for ever."""
    text = '<mujoco model="mobile"><compiler angle="radian"/><worldbody><body name="base">'
    text += '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
    text += '<joint name="turn" axis="0 0 1"/><geom type="cylinder" size="0.25 0.15"/>'
    for k, (axis, height, reach) in enumerate(LINKS, 1):
        limits = f' range="{-reach} {reach}"' if reach else ""
        text += f'<body name="link{k}" pos="0 0 {height}"><joint name="joint{k}" axis="{axis}"{limits}/>'
        text += '<geom type="capsule" size="0.04" fromto="0 0 0 0 0 0.1"/>'
    return text + '<site name="pinch" pos="0 0 0.18"/>' + "</body>" * (len(LINKS) + 1) + "</worldbody></mujoco>"


def report() -> Iterator[str]:
    """A row for each target and each way to solve."""
    robot = osik.Robot.from_mjcf(model_text())
    yield (
        "target | solved by | hand off at the end [mm] | a joint moves in a step, median [rad] | base has moved [m] | "
        "apart from mink's at the end [rad or m]"
    )
    for where in ("near", "far"):
        motions = {
            "mink": _in_mink(robot, where, lm_damping=1.0),
            "mink, another QP solver": _in_mink(robot, where, lm_damping=1.0, solver="daqp"),
            "mink, lm_damping=0": _in_mink(robot, where, lm_damping=0.0),
            "mink, lm_damping=0, another QP solver": _in_mink(robot, where, lm_damping=0.0, solver="daqp"),
            "osik-jax, curvature_damping=0": _in_osik(robot, where, "decoupled", 1.0, curvature=0.0),
            "osik-jax, defaults": _in_osik(robot, where, "decoupled", 1.0, curvature=1.0),
            "osik-jax, as mink": _in_osik(robot, where, "se3", 0.95, curvature=0.0, lm_damping=1.0),
        }
        for name, motion in motions.items():
            yield " | ".join([where, name, *_measured(robot, where, motion, motions["mink"])])


def target_at(robot: osik.Robot, where: Where) -> tuple[np.ndarray, np.ndarray]:
    """Positions (steps, 3) and the rotation of the hand's target: a curve about the start, or 0.6 m ahead of it."""
    position, rotation = osik.forward_kinematics(robot, jnp.asarray(START)).frame_pose(robot, "pinch")
    t = DT * np.arange(STEPS)
    near = [0.1 * np.sin(2.0 * t), 0.15 * np.sin(1.5 * t), 0.1 * (np.cos(2.0 * t) - 1.0)]
    far = [0.6 * np.minimum(t, 1.0), 0.1 * np.sin(1.5 * t), 0.0 * t]
    return np.asarray(position) + np.stack(near if where == "near" else far, axis=1), np.asarray(rotation)


def _in_mink(robot: osik.Robot, where: Where, *, lm_damping: float, solver: str = "quadprog") -> np.ndarray:
    model: mujoco.MjModel = robot.mj_model
    configuration = mink.Configuration(model, q=START.copy())
    hand = mink.FrameTask("pinch", "site", 1.0, 1.0, lm_damping=lm_damping)
    posture = mink.PostureTask(model, np.r_[np.zeros(2), np.full(8, 1e-3)])
    posture.set_target(START)
    tasks = [hand, posture, mink.DampingTask(model, np.r_[np.full(3, 100.0), np.zeros(7)])]
    points, rotation = target_at(robot, where)
    path = [START]
    for point in points:
        hand.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), point))
        for _ in range(ITERATIONS):
            configuration.integrate_inplace(mink.solve_ik(configuration, tasks, DT, solver, DAMPING), DT)
            error = hand.compute_error(configuration)
            if max(np.linalg.norm(error[:3]), np.linalg.norm(error[3:])) <= THRESHOLD:
                break
        path.append(configuration.q.copy())
    return np.array(path)


def _in_osik(
    robot: osik.Robot,
    where: Where,
    error: Any,
    limit_gain: float,
    *,
    curvature: float,
    lm_damping: float = 0.0,
) -> np.ndarray:
    """With ``lm_damping``: mink's term, the squared weighted error, added to the damping of the scheme."""
    points, rotation = target_at(robot, where)
    hand = osik.FrameTask(robot, "pinch", orientation_weight=1.0, gain=1.0 / DT, error=error)
    others = {
        "posture": osik.PostureTask(robot, target=START, weight=np.r_[np.zeros(2), np.full(8, 1e-6)], gain=1.0 / DT),
        "base": osik.DampingTask(robot, joints=("x", "y", "turn"), weight=100.0**2),
    }
    scheme = osik.WeightedQP(damping=DAMPING, curvature_damping=curvature)
    limits = (osik.ConfigurationLimit(robot, gain=limit_gain),)

    def missed(task: osik.FrameTask, q: Array) -> Array:
        return task.rows(robot, osik.forward_kinematics(robot, q), q).error

    def step(state: tuple[Array, Array, Array], task: osik.FrameTask) -> tuple[Array, Array, Array]:
        q, count, _ = state
        damped = scheme.replace(damping=DAMPING + lm_damping * jnp.sum(missed(task, q) ** 2))
        answer = osik.solve(robot, q, {"hand": task, **others}, scheme=damped, limits=limits, dt=DT)
        q = osik.integrate(robot, q, answer.velocity, DT)
        error = missed(task, q)
        there = jnp.maximum(jnp.linalg.norm(error[:3]), jnp.linalg.norm(error[3:])) <= THRESHOLD
        return q, count + 1, there

    def control_step(q: Array, point: Array) -> tuple[Array, Array]:
        task = hand.replace(target=(point, rotation))
        start = q, jnp.asarray(0), jnp.asarray(False)
        q, *_ = jax.lax.while_loop(lambda s: (s[1] < ITERATIONS) & ~s[2], lambda s: step(s, task), start)
        return q, q

    _, path = jax.jit(lambda q: jax.lax.scan(control_step, q, jnp.asarray(points)))(jnp.asarray(START))
    return np.concatenate([START[None], np.asarray(path)])


def _measured(robot: osik.Robot, where: Where, motion: np.ndarray, reference: np.ndarray) -> list[str]:
    hand = osik.forward_kinematics(robot, jnp.asarray(motion[-1])).frame_pose(robot, "pinch")[0]
    moved = np.abs(np.diff(motion, axis=0)).max(axis=1)[STEPS // 2 :]
    return [
        f"{1e3 * np.linalg.norm(np.asarray(hand) - target_at(robot, where)[0][-1]):.2f}",
        f"{np.median(moved):.4f}",
        f"{np.abs(motion[-1] - START)[:3].max():.3f}",
        f"{np.abs(motion[-1] - reference[-1]).max():.1e}",
    ]
