"""pink: Pinocchio, its tasks and limits, daqp."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin

from ..robots import pinocchio_model
from ..workload import DT, Workload
from ._peer import Device

pink: Any = import_module("pink")  # in the extra "bench" alone


class Runner:
    """One robot in pink's closed loop.

    Args:
        work: what to do.
        solver: of qpsolvers.
        damping: of the velocity.
        gain: share of its error that each task asks for in a step.
    """

    packages = ("pin-pink", "pin", "daqp", "qpsolvers", "numpy")

    def __init__(self, work: Workload, *, solver: str = "daqp", damping: float = 1e-9, gain: float = 1.0) -> None:
        self.work, self.solver, self.damping, self.gain = work, solver, damping, gain
        model = pinocchio_model(work.urdf, work.floating)
        self.configuration = pink.Configuration(model, model.createData(), work.start.copy())
        self._set_up_tasks()
        self.limits = [pink.limits.ConfigurationLimit(model, config_limit_gain=1.0), pink.limits.VelocityLimit(model)]

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration."""
        self.hand.set_target(pin.SE3(self.work.hand_rotation, hand))
        if self.work.feet:
            self.com.set_target(com)
        v = pink.solve_ik(
            self.configuration,
            self.tasks,
            DT,
            solver=self.solver,
            damping=self.damping,
            limits=self.limits,
            safety_break=False,
        )
        self.configuration.integrate_inplace(v, DT)
        return self.configuration.q

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's layout is the canonical one."""
        return q.copy()

    def solved(self) -> float:
        """pink raises where a QP fails."""
        return 1.0

    def device(self) -> Device:
        """A CPU."""
        return Device()

    def _set_up_tasks(self) -> None:
        work, c = self.work, self.work.costs
        self.hand = pink.tasks.FrameTask(work.hand, c.hand_position, c.hand_rotation, gain=self.gain)
        posture = pink.tasks.PostureTask(c.posture, gain=self.gain)
        posture.set_target(work.start)
        self.tasks = [self.hand, posture]
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True):
            foot = pink.tasks.FrameTask(name, c.foot, c.foot, gain=self.gain)
            foot.set_target(pin.SE3(R, p))
            self.tasks.append(foot)
        if work.feet:
            self.com = pink.tasks.ComTask(c.com, gain=self.gain)
            self.tasks.append(self.com)
