"""mink: MuJoCo C, its tasks and limits, daqp."""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from ..workload import DT, Workload


class Runner:
    """One robot in mink's closed loop."""

    packages = ("mink", "mujoco", "daqp", "qpsolvers", "numpy")

    def __init__(self, work: Workload, *, solver: str = "daqp", damping: float = 1e-9) -> None:
        self.work, self.solver, self.damping = work, solver, damping
        self.model = _model(work)
        joints = [self.model.joint(name) for name in work.joints]
        self.places = np.array([joint.qposadr[0] for joint in joints])
        start = self._own(work.start)
        self.configuration = mink.Configuration(self.model, start)
        self._set_up_tasks(start, np.array([joint.dofadr[0] for joint in joints]))
        speeds = dict(zip(work.joints, work.velocity, strict=True))
        self.limits = [mink.ConfigurationLimit(self.model, gain=1.0), mink.VelocityLimit(self.model, speeds)]

    def tick(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP, integration."""
        self.hand.set_target(mink.SE3.from_rotation_and_translation(self.hand_rotation, hand))
        if self.work.feet:
            self.com.set_target(com)
        v = mink.solve_ik(self.configuration, self.tasks, DT, self.solver, damping=self.damping, limits=self.limits)
        self.configuration.integrate_inplace(v, DT)
        return self.configuration.q

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """MuJoCo writes quaternions w x y z."""
        base = (q[:3], q[4:7], q[3:4]) if self.work.floating else ()
        return np.concatenate([*base, q[self.places]])

    def solved(self) -> float:
        """mink raises where a QP fails."""
        return 1.0

    def _own(self, q: np.ndarray) -> np.ndarray:
        own = np.zeros(self.model.nq)
        if self.work.floating:
            own[:3], own[3], own[4:7] = q[:3], q[6], q[3:6]
        own[self.places] = q[7 if self.work.floating else 0 :]
        return own

    def _set_up_tasks(self, start: np.ndarray, dofs: np.ndarray) -> None:
        work, c = self.work, self.work.costs
        self.hand = mink.FrameTask(work.hand, "body", c.hand_position, c.hand_rotation, gain=1.0)
        self.hand_rotation = mink.SO3.from_matrix(work.hand_rotation)
        cost = np.zeros(self.model.nv)
        cost[dofs] = c.posture
        posture = mink.PostureTask(self.model, cost=cost, gain=1.0)
        posture.set_target(start)
        self.tasks = [self.hand, posture]
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True):
            foot = mink.FrameTask(name, "body", c.foot, c.foot, gain=1.0)
            foot.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
            self.tasks.append(foot)
        if work.feet:
            self.com = mink.ComTask(c.com, gain=1.0)
            self.tasks.append(self.com)


def _model(work: Workload) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(work.urdf)
    spec.compiler.fusestatic = False
    if work.floating:
        spec.body(work.root).add_freejoint()
    return spec.compile()
