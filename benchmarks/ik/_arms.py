"""Arms, and poses for them: reachable by construction, at the edge, and out of reach by construction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ..descriptions import ROBOTS, Description, lean_urdf
from ..robots import pinocchio_model

_STILL = (0.0, 0.0, 0.0)
ARMS = {
    "panda": ROBOTS["panda"],
    "ur5": Description(
        root="base_link", hand="tool0", amplitude=_STILL, urdf="ur_description/urdf/ur5_joint_limited_robot.urdf"
    ),
    "xarm7": Description(root="link_base", hand="link_eef", amplitude=_STILL, urdf="xarm_description/urdf/xarm7.urdf"),
    "kinova": Description(
        root="j2s6s200_link_base",
        hand="j2s6s200_end_effector",
        amplitude=_STILL,
        urdf="kinova_description/robots/kinova.urdf",
    ),
}
ABOUT_THE_BASE = ("ur5",)
"""Arms whose last joint never comes nearer to the first one's axis than a length: the offset of their parallel axes."""
_EDGE = 0.3
"""Chance of a joint to stand at a limit, and of one to stand at 0, in the poses at the edge."""


@dataclass(frozen=True)
class Poses:
    """Targets of one kind.

    Attributes:
        positions: [m]. (n, 3)
        rotations: (n, 3, 3)
    """

    positions: np.ndarray
    rotations: np.ndarray


class Arm:
    """A robot by Pinocchio, which makes the targets and judges what comes out.

    Attributes:
        urdf: the text of its description.
        root: link that stands still.
        frame: that is brought to the targets.
        lower: of the joints, in Pinocchio's order [rad].
        upper: likewise.
        joints: names, in that order.
    """

    def __init__(self, name: str) -> None:
        given = ARMS[name]
        # joints without an end have one in the file all the same, at two turns
        self.urdf = lean_urdf(given).replace('type="continuous"', 'type="revolute"')
        self.root, self.frame = given.root, given.hand
        self.model = pinocchio_model(self.urdf, False)
        self.data = self.model.createData()
        self.lower, self.upper = self.model.lowerPositionLimit.copy(), self.model.upperPositionLimit.copy()
        self.joints = tuple(self.model.names)[1:]

    def pose(self, q: np.ndarray) -> pin.SE3:
        """Of the frame."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.model.getFrameId(self.frame)].copy()

    def reachable(self, count: int, rng: np.random.Generator) -> Poses:
        """Of configurations that are uniform within the limits."""
        return self._of(self.lower + (self.upper - self.lower) * rng.random((count, self.model.nq)))

    def at_the_edge(self, count: int, rng: np.random.Generator) -> Poses:
        """Of configurations with joints at their limits, and at 0, where many arms are singular."""
        shape = count, self.model.nq
        q = self.lower + (self.upper - self.lower) * rng.random(shape)
        kind = rng.random(shape)
        q = np.where(kind < _EDGE, np.where(rng.random(shape) < 0.5, self.lower, self.upper), q)
        return self._of(np.where(kind > 1.0 - _EDGE, np.clip(0.0, self.lower, self.upper), q))

    def out_of_reach(self, count: int, rng: np.random.Generator) -> Poses:
        """Further from the first joint than all links in one line are long, by 1 % to 100 %."""
        tip = self.model.frames[self.model.getFrameId(self.frame)].placement.translation
        links = [np.linalg.norm(placement.translation) for placement in list(self.model.jointPlacements)[2:]]
        length = sum(links) + np.linalg.norm(tip)
        way = rng.standard_normal((count, 3))
        way *= length * rng.uniform(1.01, 2.0, (count, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
        root = self.model.jointPlacements[1].translation
        return Poses(root + way, self.reachable(count, rng).rotations)

    def too_near(self, count: int, rng: np.random.Generator) -> Poses:
        """With the last joint nearer to the first one's axis than it can come, at 2 % to 98 % of that distance.

        The last joint is beside the plane of the arm's links, which holds the first axis, by the same length in all
        configurations; and at the same place in the frame's axes.
        """
        offset, tip = self._offset()
        rotations = self.reachable(count, rng).rotations
        turn, away = rng.uniform(0.0, 2.0 * np.pi, count), offset * rng.uniform(0.02, 0.98, count)
        root = self.model.jointPlacements[1].translation
        up = rng.uniform(-0.5, 0.5, count)
        last = root + np.stack([away * np.cos(turn), away * np.sin(turn), up], 1)
        return Poses(last - rotations @ tip, rotations)

    def _offset(self) -> tuple[float, np.ndarray]:
        """How far the last joint is from the plane of the links [m], and where it is in the frame's axes [m]. (3,)."""
        tip = self.pose(pin.neutral(self.model)).actInv(self.data.oMi[-1].translation)
        away = self.data.oMi[-1].translation - self.data.oMi[1].translation
        return float(abs(self.data.oMi[2].rotation[:, 1] @ away)), tip

    def errors(self, q: np.ndarray, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Distances [m] and angles [rad] from the targets."""
        away, turned = np.empty(len(q)), np.empty(len(q))
        for i, own in enumerate(q):
            pose = self.pose(own)
            away[i] = np.linalg.norm(pose.translation - poses.positions[i])
            turned[i] = np.linalg.norm(pin.log3(pose.rotation @ poses.rotations[i].T))
        return away, turned

    def _of(self, q: np.ndarray) -> Poses:
        found = [self.pose(own) for own in q]
        return Poses(np.array([p.translation for p in found]), np.array([p.rotation for p in found]))
