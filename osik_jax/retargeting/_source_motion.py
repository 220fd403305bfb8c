"""Robot motion used in place of a person's."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from .._errors import OsikValueError, unknown_name
from ..robot import Robot
from ._contact import find_contact, find_noise
from ._facing import facing_x
from ._floor import Floor, find_floor
from ._motion import CONTACT_POINTS
from ._person import Person, unit
from ._places import find_places
from ._profile import Profile
from ._profile_file import check_profile, find_profile
from ._robot_motion import RobotMotion, joints_in_mujoco_order, load_robot_motion
from ._roles import LIMBS, SIDES


@dataclasses.dataclass(frozen=True)
class SourceMotion:
    """Motion of one robot for another robot to follow; ``retarget`` accepts it in place of a ``HumanMotion``.

    Attributes:
        robot: the robot that moves; joints that the motion does not name stay at home.
        motion: its motion; missing contacts are detected as for a person.
        profile: its profile; None: a bundled one or a guess (``find_profile``).
        name: name of the clip, for display.

    Raises:
        ValueError: the base does not float, or no profile is found.
        KeyError: the motion names a joint that the robot does not have, or the profile such a frame.
    """

    robot: Robot
    motion: RobotMotion
    profile: Profile | None = None
    name: str = "robot"

    def __post_init__(self) -> None:
        if not self.robot.floating_base:
            raise OsikValueError("a source has a base that moves: load the robot with floating_base=True")
        known = joints_in_mujoco_order(self.robot)
        for name in self.motion.joint_names:
            if name not in known:
                raise unknown_name("joint", name, known)
        profile = find_profile(self.robot) if self.profile is None else self.profile
        check_profile(self.robot, profile)
        object.__setattr__(self, "profile", profile)

    @property
    def fps(self) -> float:
        """Return the frame rate [1/s]."""
        return self.motion.fps

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return len(self.motion.qpos)

    def resampled(self, fps: float) -> SourceMotion:
        """Return the motion at another rate; see ``HumanMotion.resampled``."""
        return dataclasses.replace(self, motion=self.motion.resampled(fps))

    def person(self) -> Person:
        """Return the robot's motion as that of a person: limb directions, trunk and foot orientations, contacts."""
        profile, fps = self.profile, self.motion.fps
        assert profile is not None
        hips = (profile.keypoints[f"{side}_hip"][0] for side in SIDES)
        home = np.asarray(self.robot.mujoco_qpos(facing_x(self.robot, *hips).q0))
        found = find_places(self.robot, profile, np.concatenate([home[None], self._qpos(home)]))
        upright = {role: track[0] for role, track in found.keypoints.items()}
        ankles, soles = np.mean([upright[f"{side}_ankle"][2] for side in SIDES]), found.soles[0, :, 2].mean()
        standing, contact = found.standing[1:], self.motion.contact
        noise, floor = find_noise(standing), Floor(0.0)
        if contact is None:
            floor = find_floor(standing, fps, noise)
        points = {role: track[1:] for role, track in found.keypoints.items()}
        points |= {role: standing[:, k] for k, role in enumerate(CONTACT_POINTS)}
        points = {role: floor.leveled(track, fps) for role, track in points.items()}
        if contact is None:
            leveled = np.stack([points[role] for role in CONTACT_POINTS], 1)
            contact = find_contact(leveled, fps, 0.0, noise=noise)
        turns = found.turns[1:] @ np.swapaxes(found.turns[0], -1, -2)
        return Person(
            fps=fps,
            points=points,
            directions=unit(np.stack([points[b] - points[a] for a, b in LIMBS], 1)),
            pelvis=turns[:, 0],
            torso=turns[:, 1],
            root=0.5 * (points["left_hip"] + points["right_hip"]),
            feet=turns[:, 2:],
            contact=contact,
            leg=0.5 * float(sum(np.linalg.norm(upright[b] - upright[a]) for a, b in LIMBS[:4])),
            ankle=float(ankles - soles),
        )

    def _qpos(self, home: np.ndarray) -> np.ndarray:
        """Return the motion as configurations of the robot's MuJoCo model. (F, nq)."""
        tree, model = self.robot.tree, self.robot.mj_model
        (base,) = tree.free_bases
        at = int(tree.full_qpos_address[base])
        columns = [*range(at, at + 7), *(int(model.joint(name).qposadr[0]) for name in self.motion.joint_names)]
        qpos = np.tile(home, (self.frames, 1))
        qpos[:, columns] = self.motion.qpos
        return qpos


def load_source(
    path: str | os.PathLike[str], robot: Robot, *, profile: Profile | None = None, fps: float | None = None
) -> SourceMotion:
    """Read a motion of a robot, ``motion.npz`` or a CSV, for another robot to follow.

    Args:
        path: the file; a CSV has the robot's joints in MuJoCo's order.
        robot: the robot that moves.
        profile: as of ``SourceMotion``.
        fps: frame rate of a CSV [1/s].

    Raises:
        FileNotFoundError, ValueError, KeyError: as of ``load_robot_motion`` and ``SourceMotion``.
    """
    table = Path(path).suffix.lower() == ".csv"
    names = joints_in_mujoco_order(robot) if table else None
    motion = load_robot_motion(path, joint_names=names, fps=fps if table else None)
    return SourceMotion(robot, motion, profile, Path(path).stem)
