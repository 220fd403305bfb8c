"""mink: MuJoCo C, its tasks and limits, daqp."""

from __future__ import annotations

import mink
import numpy as np

from ..workload import DT, Workload
from ._mujoco import Coordinates
from ._peer import Device


class Runner:
    """One robot in mink's closed loop.

    Args:
        work: what to do.
        solver: of qpsolvers.
        damping: of the velocity.
        gain: share of its error that each task asks for in a step.
        lm_damping: of the frame tasks, times their squared errors.
    """

    packages = ("mink", "mujoco", "daqp", "qpsolvers", "numpy")

    def __init__(
        self,
        work: Workload,
        *,
        solver: str = "daqp",
        damping: float = 1e-9,
        gain: float = 1.0,
        lm_damping: float = 0.0,
    ) -> None:
        self.work, self.solver, self.damping, self.gain, self.lm_damping = work, solver, damping, gain, lm_damping
        self.coordinates = Coordinates(work)
        model, start = self.coordinates.model, self.coordinates.own(work.start)
        self.configuration = mink.Configuration(model, start)
        self._set_up_tasks(start)
        speeds = dict(zip(work.joints, work.velocity, strict=True))
        self.limits = [mink.ConfigurationLimit(model, gain=1.0), mink.VelocityLimit(model, speeds)]

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration."""
        self.hand.set_target(mink.SE3.from_rotation_and_translation(self.hand_rotation, hand))
        if self.work.feet:
            self.com.set_target(com)
        v = mink.solve_ik(self.configuration, self.tasks, DT, self.solver, damping=self.damping, limits=self.limits)
        self.configuration.integrate_inplace(v, DT)
        return self.configuration.q

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """From MuJoCo's coordinates."""
        return self.coordinates.canonical(q)

    def solved(self) -> float:
        """mink raises where a QP fails."""
        return 1.0

    def device(self) -> Device:
        """A CPU."""
        return Device()

    def _set_up_tasks(self, start: np.ndarray) -> None:
        work, c, model = self.work, self.work.costs, self.coordinates.model
        numbers = dict(gain=self.gain, lm_damping=self.lm_damping)
        self.hand = mink.FrameTask(work.hand, "body", c.hand_position, c.hand_rotation, **numbers)
        self.hand_rotation = mink.SO3.from_matrix(work.hand_rotation)
        cost = np.zeros(model.nv)
        cost[self.coordinates.dofs] = c.posture
        posture = mink.PostureTask(model, cost=cost, gain=self.gain)
        posture.set_target(start)
        self.tasks = [self.hand, posture]
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True):
            foot = mink.FrameTask(name, "body", c.foot, c.foot, **numbers)
            foot.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
            self.tasks.append(foot)
        if work.feet:
            self.com = mink.ComTask(c.com, gain=self.gain)
            self.tasks.append(self.com)
