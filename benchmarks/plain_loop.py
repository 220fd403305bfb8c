"""Loops in plain Python, as the README shows them, beside mink's with the same robot, tasks and limits.

``python -m benchmarks.plain_loop`` prints microseconds of processor time of a step, the least of several loops.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import mink
import mujoco
import numpy as np

import osik_jax as osik

DT, STEPS, LOOPS = 0.01, 200, 9
AIM = np.array([0.2, 0.1, 0.0])
Step = Callable[[Any, np.ndarray | None], Any]
"""From a configuration and the hand's new target, if it has one, to the next configuration."""


def by_controller(robot: osik.Robot) -> Step:
    """Return the README's step."""
    controller = osik.Controller(robot, _tasks(robot), dt=DT)

    def step(q: Any, aim: np.ndarray | None) -> Any:
        found = controller.step(q, None if aim is None else {"hand": aim})
        osik.raise_if_failed(found)
        return controller.integrate(q, found.velocity)

    return step


def by_solve(robot: osik.Robot) -> Step:
    """Return the same step by the functions for JAX."""
    tasks = _tasks(robot)

    def step(q: Any, aim: np.ndarray | None) -> Any:
        found = osik.solve(robot, q, tasks, dt=DT, targets=None if aim is None else {"hand": aim})
        osik.raise_if_failed(found)
        return osik.integrate(robot, q, found.velocity, DT)

    return step


def by_mink(robot: osik.Robot) -> Step:
    """Return mink's step; in place of priorities it has weights."""
    model = mujoco.MjModel.from_xml_string(robot.to_mjcf())
    state = mink.Configuration(model, model.qpos0)
    feet = [mink.FrameTask(name, "site", position_cost=100.0, orientation_cost=10.0) for name in ("l_sole", "r_sole")]
    hand = mink.FrameTask("l_gripper", "body", position_cost=10.0, orientation_cost=0.0)
    posture = mink.PostureTask(model, cost=0.01)
    for task in (*feet, hand, posture):
        task.set_target_from_configuration(state)
    tasks = [*feet, hand, posture]
    names = (model.joint(k).name for k in range(1, model.njnt))
    speeds = {
        name: float(robot.velocity_limit[robot.joint_dof_index(name)]) for name in names if name in robot.joint_names
    }
    limits = [mink.ConfigurationLimit(model, gain=1.0), mink.VelocityLimit(model, speeds)]
    hand.set_target(mink.SE3.from_translation(AIM))

    def step(q: Any, aim: np.ndarray | None) -> Any:
        if aim is not None:
            hand.set_target(mink.SE3.from_translation(aim))
        state.integrate_inplace(mink.solve_ik(state, tasks, DT, "daqp", damping=1e-9, limits=limits), DT)
        return q

    return step


def _tasks(robot: osik.Robot) -> dict[str, Any]:
    """Return the README's tasks."""
    return {
        "left foot": osik.FrameTask(robot, "l_sole", priority=1),
        "right foot": osik.FrameTask(robot, "r_sole", priority=1),
        "hand": osik.FrameTask(robot, "l_gripper", rows="position", target=AIM, priority=2),
        "posture": osik.PostureTask(robot, priority=3),
    }


def time_of(make: Callable[[osik.Robot], Step], robot: osik.Robot, moving: bool) -> float:
    """Return the time of a step [us]."""
    found = []
    for _ in range(LOOPS):
        step, q, begin = make(robot), robot.q0, 0.0
        for k in range(-10, STEPS):
            if k == 0:
                begin = time.process_time()
            q = step(q, AIM + np.array([0.0, 0.0, 3e-4 * k]) if moving else None)
        found.append((time.process_time() - begin) / STEPS)
    return 1e6 * min(found)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    osik.runtime.configure_cpu()
    nao = osik.load_robot("nao")
    print(f"{'':12s} {'target at rest':>15s} {'moving target':>15s}  [us a step]")
    for make in (by_controller, by_solve, by_mink):
        times = [time_of(make, nao, moving) for moving in (False, True)]
        print(f"{make.__name__:12s} {times[0]:15.0f} {times[1]:15.0f}", flush=True)
