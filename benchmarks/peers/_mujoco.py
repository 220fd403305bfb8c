"""What the peers on MuJoCo share: its model of the workload, and its order of coordinates."""

from __future__ import annotations

import mujoco
import numpy as np

from ..workload import Workload


class Coordinates:
    """MuJoCo's model of a workload's robot. Its quaternions are w x y z, its joints in an order of their own.

    Attributes:
        model: of MuJoCo.
        places, dofs: of the workload's joints, in qpos and qvel.
    """

    def __init__(self, work: Workload) -> None:
        self.floating, self.model = work.floating, _model(work)
        joints = [self.model.joint(name) for name in work.joints]
        self.places = np.array([joint.qposadr[0] for joint in joints])
        self.dofs = np.array([joint.dofadr[0] for joint in joints])

    def own(self, q: np.ndarray) -> np.ndarray:
        """qpos of a canonical configuration."""
        own = np.zeros(self.model.nq)
        if self.floating:
            own[:3], own[3], own[4:7] = q[:3], q[6], q[3:6]
        own[self.places] = q[7 if self.floating else 0 :]
        return own

    def canonical(self, q: np.ndarray) -> np.ndarray:
        """Canonical configurations of qpos, (..., nq)."""
        base = (q[..., :3], q[..., 4:7], q[..., 3:4]) if self.floating else ()
        return np.concatenate([*base, q[..., self.places]], axis=-1)

    def quaternion(self, rotation: np.ndarray) -> np.ndarray:
        """Of a rotation matrix, w x y z."""
        found = np.zeros(4)
        mujoco.mju_mat2Quat(found, np.ascontiguousarray(rotation).ravel())
        return found


def _model(work: Workload) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(work.urdf)
    spec.compiler.fusestatic = False
    if work.floating:
        spec.body(work.root).add_freejoint()
    return spec.compile()
