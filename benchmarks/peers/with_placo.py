"""PlaCo: C++ with Pinocchio and eiquadprog; its tasks ask for their whole error in one step by themselves."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..workload import DT, Workload
from ._peer import Device

placo: Any = import_module("placo")  # in an environment of its own, where nothing checks types


class Runner:
    """One robot in PlaCo's closed loop."""

    packages = ("placo", "pin", "numpy")

    def __init__(self, work: Workload, *, damping: float = 1e-9) -> None:
        self.work = work
        self.robot = _robot(work)
        self.places = np.array([self.robot.get_joint_offset(name) for name in work.joints])
        self._stand()
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.mask_fbase(not work.floating)
        self.solver.dt = DT
        self.solver.enable_joint_limits(True)
        self.solver.enable_velocity_limits(True)
        self._set_up_tasks()
        self.solver.add_regularization_task(damping)

    def step(self, hand: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Targets, QP and integration in one call."""
        self.pose[:3, 3] = hand
        self.hand.T_world_frame = self.pose
        if self.work.feet:
            self.com.target_world = com
        self.solver.solve(True)
        self.robot.update_kinematics()
        return self.robot.state.q

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """PlaCo always has a base."""
        return np.concatenate([q[:7] if self.work.floating else q[:0], q[self.places]])

    def solved(self) -> float:
        """PlaCo raises where a QP fails."""
        return 1.0

    def device(self) -> Device:
        """A CPU."""
        return Device()

    def _stand(self) -> None:
        joints = self.work.start[7 if self.work.floating else 0 :]
        for name, angle in zip(self.work.joints, joints, strict=True):
            self.robot.set_joint(name, float(angle))
        self.robot.update_kinematics()
        for name, p, R in zip(self.work.feet[:1], self.work.foot_positions, self.work.foot_rotations, strict=False):
            self.robot.set_T_world_frame(name, _pose(p, R))
        self.robot.update_kinematics()

    def _set_up_tasks(self) -> None:
        work, c, solver = self.work, self.work.costs, self.solver
        for name, p, R in zip(work.feet, work.foot_positions, work.foot_rotations, strict=True):
            solver.add_frame_task(name, _pose(p, R)).configure(name, "soft", c.foot**2, c.foot**2)
        self.pose = _pose(work.hand_position, work.hand_rotation)
        self.hand = solver.add_frame_task(work.hand, self.pose)
        self.hand.configure("hand", "soft", c.hand_position**2, c.hand_rotation**2)
        if work.feet:
            self.com = solver.add_com_task(work.com_start)
            self.com.configure("com", "soft", c.com**2)
        joints = work.start[7 if work.floating else 0 :]
        posture = solver.add_joints_task()
        posture.set_joints({name: float(angle) for name, angle in zip(work.joints, joints, strict=True)})
        posture.configure("posture", "soft", c.posture**2)


def _robot(work: Workload) -> Any:
    """PlaCo reads files."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(work.urdf, encoding="utf-8")
        return placo.RobotWrapper(str(path), placo.Flags.ignore_collisions)


def _pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose
