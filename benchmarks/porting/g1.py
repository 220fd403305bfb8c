"""A G1 in Pinocchio and here, and configurations from one to the other."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

import osik_jax as osik

from ..descriptions import ROBOTS, lean_urdf
from ..robots import pinocchio_model

DT = 0.005
FEET = ROBOTS["g1"].feet
HANDS = ("left_wrist_yaw_link", "right_wrist_yaw_link")
BEND = {"hip_pitch": -1.0, "knee": 2.0, "ankle_pitch": -1.0}


class G1:
    """The robot in both libraries."""

    def __init__(self) -> None:
        text = lean_urdf(ROBOTS["g1"])
        self.robot = osik.Robot.from_urdf(text, floating_base=True)
        self.model = pinocchio_model(text, floating=True)
        joints = [self.model.joints[i] for i in range(2, self.model.njoints)]
        names = [self.model.names[i] for i in range(2, self.model.njoints)]
        self._theirs = np.array([(joint.idx_q, joint.idx_v) for joint in joints])
        indices = [(self.robot.joint_qpos_index(name), self.robot.joint_dof_index(name)) for name in names]
        self._ours = np.array(indices)
        self.knees = [joint.idx_q for joint, name in zip(joints, names, strict=True) if "knee" in name]

    def configuration(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration as ours: the quaternion begins with w."""
        out = np.zeros(self.robot.nq)
        out[:7] = *q[:3], q[6], *q[3:6]
        out[self._ours[:, 0]] = q[self._theirs[:, 0]]
        return out

    def pinocchio_configuration(self, q: np.ndarray) -> np.ndarray:
        """Ours as Pinocchio's."""
        out = np.zeros(self.model.nq)
        out[:7] = *q[:3], *q[4:7], q[3]
        out[self._theirs[:, 0]] = q[self._ours[:, 0]]
        return out

    def velocity(self, v: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Pinocchio's velocity at its configuration q as ours: the base's linear part in the world's axes."""
        out = np.zeros(self.robot.nv)
        out[:3] = pin.Quaternion(*q[[6, 3, 4, 5]]).matrix() @ v[:3]
        out[3:6] = v[3:6]
        out[self._ours[:, 1]] = v[self._theirs[:, 1]]
        return out

    def standing(self, height: float, bend: float) -> np.ndarray:
        """Pinocchio's configuration with the pelvis at a height [m] and the legs bent by an angle [rad]."""
        q = pin.neutral(self.model)
        q[2] = height
        for side in ("left", "right"):
            for joint, factor in BEND.items():
                q[self.model.joints[self.model.getJointId(f"{side}_{joint}_joint")].idx_q] = factor * bend
        return q

    def poses(self, q: np.ndarray, frames: tuple[str, ...]) -> dict[str, pin.SE3]:
        """Of some frames at Pinocchio's configuration."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, q)
        return {frame: data.oMf[self.model.getFrameId(frame)].copy() for frame in frames}

    def com(self, q: np.ndarray) -> np.ndarray:
        """The centre of mass at Pinocchio's configuration."""
        return pin.centerOfMass(self.model, self.model.createData(), q).copy()
