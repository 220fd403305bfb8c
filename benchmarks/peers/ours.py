"""osik_jax: one jitted step, or that step over a batch, which CPU devices share."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np

import osik_jax as osik
from osik_jax.runtime import configure_cpu
from osik_jax.scaling import sharded

from ..device import device_bytes, device_name
from ..workload import DT, Workload
from ._peer import Device

SCHEMES: dict[str, Callable[[], osik.Scheme]] = {
    "weighted": lambda: osik.WeightedQP(damping=1e-9),
    "null-space": osik.NullSpace,
    "hierarchical": osik.HierarchicalQP,
}
"""The weighted scheme has the damping of the peers, the others their defaults."""


class Runner:
    """One robot, or a batch of them, in our closed loop.

    Args:
        work: what to do.
        scheme: of ``SCHEMES``.
        precision: ``float64`` or ``float32``.
        batch: number of robots; None for one without a batch axis.
        warm: carry the active set from step to step.
        devices: CPU devices that the batch is split over, one for each core.
        resident: of a batch, the configurations of all but so many robots stay on the device.
    """

    packages = ("osik-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")

    def __init__(
        self,
        work: Workload,
        *,
        scheme: str = "weighted",
        precision: str = "float64",
        batch: int | None = None,
        warm: bool = True,
        devices: int = 1,
        resident: int | None = None,
    ) -> None:
        if devices > 1:
            jax.config.update("jax_num_cpu_devices", devices)
        if jaxlib.version.__version_info__ < (0, 11):  # compiles in three fifths of the time, runs as fast
            os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
        configure_cpu()
        jax.config.update("jax_enable_x64", precision == "float64")
        self.work, self.batch, self.resident = work, batch, resident
        self.robot = standing(work)
        self.places = np.array(places(self.robot, work))
        start = self.robot.q0
        step = step_of(self.robot, work, SCHEMES[scheme](), start)
        none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), _warm_start(step, start))
        self.q, self.warm_start = start, none
        self.program, self.warm = jax.jit(step), warm
        if batch is not None:
            self.program = sharded(step, in_axes=(0, 0, 0, None))
            self.q, self.warm_start = jax.tree.map(lambda a: jnp.tile(a, (batch, *[1] * a.ndim)), (start, none))
        self.none = self.warm_start
        self.fine: list[jax.Array] = []

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration in one program."""
        self.q, self.warm_start, fine = self.program(
            self.q, self.warm_start if self.warm else self.none, hand.astype(self.q.dtype), com.astype(self.q.dtype)
        )
        self.fine.append(fine)
        return np.asarray(self.q if self.resident is None else jax.block_until_ready(self.q)[: self.resident])

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """Our quaternions are w x y z."""
        return q[..., self.places]

    def solved(self) -> float:
        """Share of the lanes and steps so far whose status is SOLVED."""
        return float(np.mean([np.mean(np.asarray(fine)) for fine in self.fine]))

    def device(self) -> Device:
        """JAX's."""
        return Device(device_name(), device_bytes())


def standing(work: Workload) -> osik.Robot:
    """The workload's robot; its home is the workload's start."""
    robot = osik.Robot.from_urdf(work.urdf, floating_base=work.floating)
    q = np.array(robot.q0)
    q[places(robot, work)] = work.start
    return replace(robot, q0=jnp.asarray(q))


def places(robot: osik.Robot, work: Workload) -> list[int]:
    """Where in our configuration each number of a canonical one stands."""
    joints = [robot.joint_qpos_index(name) for name in work.joints]
    return [0, 1, 2, 4, 5, 6, 3, *joints] if work.floating else joints


def tasks_of(robot: osik.Robot, work: Workload, start: jax.Array) -> dict[str, osik.Task]:
    """The workload's tasks; priorities matter to the schemes that rank, weights within a level."""
    c, gain = work.costs, 1.0 / DT
    tasks: dict[str, osik.Task] = {
        name: osik.FrameTask(
            robot, name, target=(p, R), weight=c.foot**2, orientation_weight=1.0, priority=1, gain=gain
        )
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True)
    }
    if work.feet:
        tasks["com"] = osik.ComTask(robot, target=work.com_start, weight=c.com**2, priority=2, gain=gain)
    tasks["hand"] = osik.FrameTask(
        robot,
        work.hand,
        target=(work.hand_position, work.hand_rotation),
        position_weight=c.hand_position**2,
        orientation_weight=c.hand_rotation**2,
        priority=3,
        gain=gain,
    )
    tasks["posture"] = osik.PostureTask(robot, target=start, weight=c.posture**2, priority=4, gain=gain)
    return tasks


def step_of(robot: osik.Robot, work: Workload, scheme: osik.Scheme, start: jax.Array) -> Callable[..., Any]:
    """(q, warm start, hand, centre of mass) to (q, warm start, solved), as a user's control loop would have it."""
    tasks = tasks_of(robot, work, start)
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot)
    rotation = jnp.asarray(work.hand_rotation, robot.q0.dtype)

    def step(q: jax.Array, warm_start: Any, hand: jax.Array, com: jax.Array) -> tuple[jax.Array, Any, jax.Array]:
        aimed = tasks | {"hand": tasks["hand"].replace(target=(hand, rotation))}
        if "com" in tasks:
            aimed["com"] = tasks["com"].replace(target=com)
        solution = osik.solve(robot, q, aimed, scheme=scheme, limits=limits, dt=DT, warm_start=warm_start)
        q = osik.integrate(robot, q, solution.velocity, DT)
        return q, solution.warm_start, solution.status == osik.Status.SOLVED

    return step


def _warm_start(step: Callable[..., Any], start: jax.Array) -> Any:
    """Shapes of a warm start, from a step that is traced and not run."""
    point = jnp.zeros(3, start.dtype)
    return jax.eval_shape(lambda q: step(q, None, point, point)[1], start)
