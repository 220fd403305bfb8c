"""mink-warp: MuJoCo Warp, mink's tasks and limits, ADMM; all robots in one configuration, on a GPU as one CUDA graph.

mujoco up to 3.12: later ones compare joint types in another way, and it finds no joint that has limits.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from ..workload import DT, Workload
from ._mujoco import Coordinates
from ._peer import Device

mink_warp: Any = import_module("mink_warp")  # in an environment of its own, where nothing checks types
warp: Any = import_module("warp")


class Runner:
    """One robot, or a batch of them, in mink-warp's closed loop; always in single precision.

    Args:
        work: what to do.
        batch: number of robots; None for one.
        resident: the configurations of all but the first lanes stay on the device.
        iterations: of ADMM, in every step.
        damping: of the velocities, the peers' common one.
    """

    packages = ("mink-warp", "mujoco-warp", "warp-lang", "mujoco", "numpy")

    def __init__(
        self,
        work: Workload,
        *,
        batch: int | None = None,
        resident: int | None = None,
        iterations: int = 30,
        damping: float = 1e-9,
    ) -> None:
        warp.config.quiet = True
        self.work, self.batch, self.resident = work, batch, resident
        self.coordinates = Coordinates(work)
        self.where = "cuda" if warp.is_cuda_available() else "cpu"
        model, start = self.coordinates.model, self.coordinates.own(work.start)
        worlds = np.tile(start, (batch or 1, 1)).astype(np.float32)
        self.configuration = mink_warp.Configuration(model, worlds, nworld=batch or 1, device=self.where)
        self._set_up_tasks(start)
        speeds = dict(zip(work.joints, work.velocity, strict=True))
        limits = [mink_warp.ConfigurationLimit(model, gain=1.0), mink_warp.VelocityLimit(model, speeds)]
        self.solver = mink_warp.ConstrainedSolver(
            self.configuration, limits=limits, admm_iters=iterations, damping=damping
        )

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration."""
        self.pose[:, 4:] = hand
        with warp.ScopedDevice(self.where):
            self.hand.set_target(self.pose, configuration=self.configuration)
            if self.work.feet:
                self.com.set_target(com, configuration=self.configuration)
        self.solver.solve_and_integrate(self.tasks, DT, use_graph=True)
        warp.synchronize_device(self.where)
        q = self.configuration.q
        found = (q if self.resident is None else q[: self.resident]).numpy()
        return found[0] if self.batch is None else found

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """From MuJoCo's coordinates."""
        return self.coordinates.canonical(q)

    def solved(self) -> float:
        """ADMM runs its iterations and does not say."""
        return float("nan")

    def device(self) -> Device:
        """Warp's, with what its pool has held."""
        if self.where == "cpu":
            return Device()
        return Device(warp.get_device(self.where).name, warp.get_mempool_used_mem_high(self.where))

    def _set_up_tasks(self, start: np.ndarray) -> None:
        work, c, model = self.work, self.work.costs, self.coordinates.model
        self.hand = mink_warp.FrameTask(work.hand, "body", c.hand_position, c.hand_rotation, gain=1.0)
        self.pose = np.tile(self._pose(work.hand_position, work.hand_rotation), (self.configuration.nworld, 1))
        cost = np.zeros(model.nv)
        cost[self.coordinates.dofs] = c.posture
        posture = mink_warp.PostureTask(model, cost=cost, gain=1.0)
        posture.set_target(start)
        self.tasks = [self.hand, posture]
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True):
            foot = mink_warp.FrameTask(name, "body", c.foot, c.foot, gain=1.0)
            foot.set_target(self._pose(p, R))
            self.tasks.append(foot)
        if work.feet:
            self.com = mink_warp.ComTask(c.com, gain=1.0)
            self.tasks.append(self.com)

    def _pose(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Quaternion w x y z, then the position."""
        return np.concatenate([self.coordinates.quaternion(rotation), position]).astype(np.float32)
