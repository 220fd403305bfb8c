"""Inverse kinematics of humanoids: both hands to poses, feet held, the centre of mass over them; judged by MuJoCo.

    python -m benchmarks.ik.humanoids [results.json] [--robots g1 nao] [--poses 256] [--precision float64]

The poses are those of configurations that stand: random ones, brought back onto the feet. Hands of a G1 have whole
poses, those of a NAO, whose arms have five joints, positions. A pose counts as found where MuJoCo says that hands and
feet are within 1 mm and 0.01 rad and the centre of mass within 1 mm of the feet's polygon. Times are of the whole call,
compiling left out.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.runtime import configure_cpu

from ..descriptions import ROBOTS
from ..machine import processor
from ..throughput import loaded, soles

HANDS = {"g1": ("left_wrist_yaw_link", "right_wrist_yaw_link"), "nao": ("l_gripper", "r_gripper")}
POSITION, ORIENTATION = 1e-3, 1e-2
_SHARE = 0.9
"""Of the way from home to a random configuration that a pose may be made at."""


def standing_tasks(name: str, robot: osik.Robot) -> tuple[dict[str, osik.Task], osik.SupportPolygon]:
    """Feet where they are, centre of mass over them."""
    feet = ROBOTS[name].feet
    polygon = osik.support_polygon(robot, robot.q0, feet, margin=0.005, corners=soles(name))
    tasks: dict[str, osik.Task] = {foot: osik.FrameTask(robot, foot, weight=10.0) for foot in feet}
    return {**tasks, "balance": osik.ComTask(robot, polygon=polygon, weight=10.0)}, polygon


def standing_configurations(robot: osik.Robot, tasks: dict[str, osik.Task], count: int) -> np.ndarray:
    """Random configurations, brought back onto the feet; those that could not be are left out."""
    rng = np.random.default_rng(0)
    q = np.tile(np.asarray(robot.q0), (count, 1))
    lower, upper = np.asarray(robot.position_lower)[6:], np.asarray(robot.position_upper)[6:]
    q[:, 7:] += (
        _SHARE * rng.random((count, 1)) * (lower + (upper - lower) * rng.random((count, robot.nq - 7)) - q[:, 7:])
    )
    stand = jax.jit(jax.vmap(lambda q: osik.inverse_kinematics(robot, tasks, q0=q, seeds=1, steps=60)))
    found = stand(jnp.asarray(q))
    return np.asarray(found.q)[np.asarray(found.converged)]


class Judge:
    """MuJoCo's kinematics of a robot."""

    def __init__(self, robot: osik.Robot) -> None:
        self.robot, self.data = robot, mujoco.MjData(robot.mj_model)

    def along(self, q: np.ndarray) -> Iterator[None]:
        """Moves to one configuration after the other. (n, nq)."""
        for own in np.asarray(jax.jit(jax.vmap(self.robot.mujoco_qpos))(jnp.asarray(q)), float):
            self._move(own)
            yield

    def at(self, q: np.ndarray) -> None:
        """Moves to one. (nq,)."""
        self._move(np.asarray(self.robot.mujoco_qpos(jnp.asarray(q))))

    def _move(self, qpos: np.ndarray) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.robot.mj_model, self.data)
        mujoco.mj_comPos(self.robot.mj_model, self.data)

    def pose(self, frame: str) -> tuple[np.ndarray, np.ndarray]:
        """Of a body, or of a site that stands for a link without a joint."""
        model = self.robot.mj_model
        own = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame)
        of = self.data.body(frame) if own >= 0 else self.data.site(frame)
        return of.xpos.copy(), of.xmat.reshape(3, 3).copy()


def errors(judge: Judge, wanted: dict[str, tuple[np.ndarray, np.ndarray]], free: tuple[str, ...]) -> Any:
    """Largest distance and angle of any frame where the judge is; those that are free may turn."""
    away, turned = [], [0.0]
    for name, (position, rotation) in wanted.items():
        p, r = judge.pose(name)
        away.append(np.linalg.norm(p - position))
        if name not in free:
            turned.append(np.arccos(np.clip((np.trace(r @ rotation.T) - 1.0) / 2.0, -1.0, 1.0)))
    return max(away), max(turned)


def measured(name: str, poses: int) -> dict[str, Any]:
    """One robot."""
    robot = loaded(name)
    stance, polygon = standing_tasks(name, robot)
    q, judge, hands = standing_configurations(robot, stance, poses), Judge(robot), HANDS[name]
    rows = "pose" if name == "g1" else "position"
    tasks = {
        **stance,
        **{hand: osik.FrameTask(robot, hand, rows=rows, orientation_weight=0.05) for hand in hands},
        "posture": osik.PostureTask(robot, weight=1e-4),
    }
    judge.at(np.asarray(robot.q0))
    held = {foot: judge.pose(foot) for foot in ROBOTS[name].feet}
    goals = [{hand: judge.pose(hand) for hand in hands} for _ in judge.along(q)]
    targets = {hand: tuple(np.stack([goal[hand][part] for goal in goals]) for part in (0, 1)) for hand in hands}

    def find() -> osik.InverseKinematicsSolution:
        return osik.inverse_kinematics(robot, tasks, targets=targets, seeds=16, restarts=3)

    find()
    start = time.perf_counter()
    found = find()
    configurations, seconds = np.asarray(found.q), time.perf_counter() - start
    free = () if name == "g1" else hands
    judged, centres = [], []
    for goal, _ in zip(goals, judge.along(configurations), strict=True):
        judged.append(errors(judge, held | goal, free))
        centres.append(judge.data.subtree_com[0][:2].copy())
    away, turned = np.array(judged).T
    balance = jax.vmap(polygon.distance)(jnp.asarray(centres))
    good = (away <= POSITION) & (turned <= ORIENTATION) & (np.array(balance) >= -POSITION)
    joints = configurations[:, 7:].astype(float)
    lower, upper = np.asarray(robot.position_lower)[6:], np.asarray(robot.position_upper)[6:]
    called = np.asarray(found.converged)
    return {
        "poses": len(q),
        "found": float(good.mean()),
        "wrongly called found": int((called & ~good).sum()),
        "limits broken": int(((joints < lower) | (joints > upper)).any(1).sum()),
        "median position error [m]": float(np.median(away)),
        "poses a second": len(q) / seconds,
        "load average": os.getloadavg()[0],
    }


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ik.humanoids", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("results", type=Path, nargs="?")
    parser.add_argument("--robots", nargs="+", choices=sorted(HANDS), default=list(HANDS))
    parser.add_argument("--poses", type=int, default=256)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float64")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", given.precision == "float64")
    results = {name: measured(name, given.poses) for name in given.robots}
    print(json.dumps(results, indent=1))
    if given.results is not None:
        setting = {"precision": given.precision, "device": jax.devices()[0].device_kind, "processor": processor()}
        given.results.write_text(json.dumps({"setting": setting, "results": results}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    configure_cpu()
    main()
