"""A Unitree G1 that stands and sends both hands into a table: times of a step with and without the limit of collisions.

    python -m benchmarks.scene_loop [--steps 400]

A step of ``osik.Controller``, and of ``solve`` and ``integrate`` inside ``jit``, in microseconds, shortest and median;
the least distance of the pairs that the limit keeps apart, in every tenth configuration.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik

DT, KEPT = 0.005, 0.01
"""Time of a step [s], and the distance that the limit keeps [m]."""
FEET = "left_ankle_roll_link", "right_ankle_roll_link"
HANDS = {"left_rubber_hand": [0.4, 0.2, 0.2], "right_rubber_hand": [0.4, -0.2, 0.2]}
TABLE = [0.25, 0.5, 0.02], [0.55, 0.0, 0.2]
"""Half edges and middle of the table [m]; the hands are sent into it."""


def main() -> None:
    """Run the four loops."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    osik.runtime.configure_cpu()
    robot = osik.load_robot("g1")
    tasks: dict[str, Any] = {foot: osik.FrameTask(robot, foot, weight=100.0, gain=10.0) for foot in FEET}
    tasks["com"] = osik.ComTask(robot, weight=10.0, gain=5.0, axes="xy")
    tasks |= {hand: osik.FrameTask(robot, hand, rows="position", gain=5.0) for hand in HANDS}
    tasks["posture"] = osik.PostureTask(robot, weight=1e-2, gain=1.0)
    targets = {hand: (np.array(point), np.eye(3)) for hand, point in HANDS.items()}
    scene = osik.Scene({"table": osik.CollisionShape.box(*TABLE)})
    speeds = osik.VelocityLimit(robot, velocity={"*": 5.0})
    apart = osik.CollisionAvoidanceLimit(robot, scene=scene, minimum_distance=KEPT)
    for name, loop in (("Controller.step", plain), ("solve and integrate inside jit", compiled)):
        for limits in ((speeds,), (speeds, apart)):
            seconds, q = loop(robot, tasks, limits, targets, given.steps)
            distances = [np.min(apart.distances(robot, osik.forward_kinematics(robot, one))) for one in q[::10]]
            print(
                f"{name}, {'with' if apart in limits else 'without'} the limit: {1e6 * seconds.min():.0f}, "
                f"{1e6 * np.median(seconds):.0f} us; nearest pair {1e3 * min(distances):.1f} mm"
            )


def plain(robot: osik.Robot, tasks: Any, limits: Any, targets: Any, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return seconds of each step, and the configurations."""
    controller = osik.Controller(robot, tasks, limits=limits, dt=DT)
    q, seconds, path = np.asarray(robot.q0), [], []
    controller.step(q, targets)
    for _ in range(steps):
        start = time.perf_counter()
        step = controller.step(q, targets)
        seconds.append(time.perf_counter() - start)
        q = controller.integrate(q, step.velocity)
        path.append(q)
    return np.array(seconds), np.array(path)


def compiled(robot: osik.Robot, tasks: Any, limits: Any, targets: Any, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of a compiled step."""

    @jax.jit
    def move(q: Any, warm: Any, targets: Any) -> Any:
        step = osik.solve(robot, q, tasks, limits=limits, dt=DT, targets=targets, warm_start=warm)
        return osik.integrate(robot, q, step.velocity, DT), step.warm_start

    targets = jax.tree.map(jnp.asarray, targets)
    first = osik.solve(robot, robot.q0, tasks, limits=limits, dt=DT, targets=targets)
    state, seconds, path = (robot.q0, first.warm_start), [], []
    jax.block_until_ready(move(*state, targets))
    for _ in range(steps):
        start = time.perf_counter()
        state = jax.block_until_ready(move(*state, targets))
        seconds.append(time.perf_counter() - start)
        path.append(state[0])
    return np.array(seconds), np.array(path)


if __name__ == "__main__":
    main()
