"""Figures of docs/jogging.md, docs/tasks_and_limits.md and docs/data/measurements.md.

    python -m benchmarks.jogging

A UR5 turns its tool past a singular wrist, an arm7 rests beside a posture, and an SO-101 holds a pose seen with noise.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik

PLACE, DOWN = np.array([0.45, 0.15, 0.25]), np.array([0.0, 1.0, 0.0, 0.0])
START = np.array([0.0, -1.2, 1.6, -2.0, -1.57, 0.0])
HOME = np.array([0.0, -0.5, 0.5, 0.6, 0.2, 0.3])


def past_the_wrist() -> None:
    """Print the errors of a turn at 0.5 rad/s about x that passes 0.09 rad beside the wrist's singularity."""
    arm, dt, steps = osik.load_robot("ur5"), 0.01, 600
    q = osik.inverse_kinematics(arm, {"tool0": (PLACE, DOWN)}, q0=jnp.array(START)).q
    poses = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "tool0")))
    p, R = (a[0] for a in poses(q[None]))
    turns = Rotation.from_rotvec(
        np.outer(0.5 * dt * np.arange(1, steps + 1), [1.0, 0.0, 0.0])
    ).as_matrix() @ np.asarray(R)
    goal = jnp.tile(p, (steps, 1)), jnp.array(turns)
    shared: Any = dict(gain=50.0)
    ranked: Any = {
        name: osik.FrameTask(arm, "tool0", rows=name, priority=rank, **shared).at(arm, q)
        for rank, name in enumerate(("position", "orientation"), 1)
    }
    cases: dict[str, Any] = {
        f"`orientation_weight={weight:g}`": {"tool": osik.FrameTask(arm, "tool0", orientation_weight=weight, **shared)}
        for weight in (1.0, 0.1, 0.01, 0.001)
    }
    cases["position above orientation"] = ranked
    print("| tasks | position [mm] | orientation [deg] |\n|---|---|---|")
    for name, tasks in cases.items():
        aims = {task: goal for task in tasks if task != "position"}
        path = osik.rollout(arm, q, tasks, dt=dt, steps=steps, targets=aims)
        at, turned = map(np.asarray, poses(path.q[1:]))
        angle = Rotation.from_matrix(turned @ turns.transpose(0, 2, 1)).magnitude().max()
        print(f"| {name} | {1e3 * np.linalg.norm(at - p, axis=1).max():.2f} | {np.rad2deg(angle):.1f} |")


def beside_a_posture() -> None:
    """Print how far an arm7 rests off its target beside a posture of the same priority; medians of ten targets."""
    arm, rng = osik.load_robot("arm7"), np.random.default_rng(1)
    poses = jax.jit(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "hand"))
    away = np.clip(arm.q0 + 0.6 * rng.normal(size=(10, arm.nq)), arm.position_lower, arm.position_upper)

    @jax.jit
    def errors(target: Any, length: float, weight: float) -> jax.Array:
        hand = osik.FrameTask(arm, "hand", target=target, orientation_weight=length**2)
        tasks = {"hand": hand, "posture": osik.PostureTask(arm, weight=weight)}
        path = osik.rollout(arm, arm.q0, tasks, scheme=osik.WeightedQP(), dt=0.02, steps=300)
        return jnp.linalg.norm(path.solution.error["hand"][-1].reshape(2, 3), axis=1)

    print("\n| weight of the posture | position [mm] | orientation [rad] | with `orientation_weight=1.0` |")
    print("|---|---|---|---|")
    for weight in (1e-3, 1e-4, 1e-5):
        ours, theirs = (np.median([errors(poses(q), length, weight) for q in away], 0) for length in (0.1, 1.0))
        print(f"| {weight:.0e} | {1e3 * ours[0]:.2g} | {ours[1]:.2g} | {theirs[1]:.2g} |")


def noise() -> None:
    """Print the motion for a pose at rest that is seen with 1 mm and 0.5 degrees of white noise at 50 Hz."""
    arm, frame, dt, steps, rng = osik.load_robot("so101"), "gripper_frame_link", 0.02, 1000, np.random.default_rng(0)
    poses = jax.jit(jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, frame)))
    p, R = (np.asarray(a)[0] for a in poses(HOME[None]))
    seen = p + 1e-3 * rng.normal(size=(steps, 3))
    turned = jnp.array(Rotation.from_rotvec(np.deg2rad(0.5) * rng.normal(size=(steps, 3))).as_matrix() @ R)
    smooth = [p]
    for point in seen:
        smooth.append(smooth[-1] + 0.1 * (point - smooth[-1]))

    def moved(points: Any, extra: Any = None, limits: Any = None, gain: float = 10.0, rows: Any = "pose") -> str:
        hand = osik.FrameTask(arm, frame, rows=rows, gain=gain)
        tasks = {"hand": hand, "posture": osik.PostureTask(arm, weight=1e-5, target=HOME), **(extra or {})}
        aims = {"hand": (jnp.array(points), turned)}
        path = osik.rollout(arm, HOME, tasks, limits=limits, dt=dt, steps=steps, targets=aims)
        q, v = np.asarray(path.q)[200:], np.asarray(path.solution.velocity)[200:]
        hand_noise = np.asarray(poses(path.q[200:])[0]).std(0).max()
        return f"{np.rad2deg(q.std(0).max()):.2f} | {1e3 * hand_noise:.2f} | {np.sqrt((v**2).mean(0)).max():.3f}"

    def smoothed(weight: float, priority: int = 1) -> Any:
        return {"smooth": osik.LowAccelerationTask(arm, weight=weight, priority=priority)}

    cases: dict[str, dict[str, Any]] = {
        "gain 10": {},
        "gain 3": dict(gain=3.0),
        "gain 1": dict(gain=1.0),
        "`DampingTask`, weight 0.01": dict(extra={"calm": osik.DampingTask(arm, weight=0.01)}),
        "`LowAccelerationTask`, weight 0.03": dict(extra=smoothed(0.03)),
        "`LowAccelerationTask`, weight 0.3": dict(extra=smoothed(0.3)),
        "gain 30": dict(gain=30.0),
        "gain 30, `LowAccelerationTask`, weight 0.03": dict(gain=30.0, extra=smoothed(0.03)),
        "`LowAccelerationTask`, priority 2": dict(extra=smoothed(0.3, 2)),
        "`AccelerationLimit` of 5 rad/s²": dict(limits=(osik.AccelerationLimit(arm, {"*": 5.0}),)),
        "`AccelerationLimit` of 1 rad/s²": dict(limits=(osik.AccelerationLimit(arm, {"*": 1.0}),)),
    }
    columns = "joints [deg] | hand [mm] | joint speed [rad/s]"
    print(f"\n| | whole pose: {columns} | position alone: {columns} |")
    print("|---|---|---|---|---|---|---|")
    for name, case in cases.items():
        print(f"| {name} | {moved(seen, **case)} | {moved(seen, rows='position', **case)} |")
    print(f"| targets low-passed, gain 10 | | | | {moved(smooth[1:], rows='position')} |")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    osik.runtime.configure_cpu()
    past_the_wrist()
    beside_a_posture()
    noise()
