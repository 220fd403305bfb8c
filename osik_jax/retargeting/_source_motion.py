"""Robot motion used in place of a person's."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from .._errors import OsikValueError, unknown_name
from ..robot import Robot
from ._contact import find_contact, find_ground, find_noise, noise_steps
from ._facing import facing_x
from ._person import Person, bone_length, palm_axes, path_of
from ._places import find_places
from ._profile import Profile
from ._profile_file import check_profile, find_profile
from ._robot_motion import RobotMotion, base_columns, joints_in_mujoco_order
from ._roles import FINGER_REACHES, LIMBS, REACHES, SIDES


@dataclasses.dataclass(frozen=True)
class SourceMotion:
    """Motion of one robot for another robot to follow; ``retarget`` accepts it in place of a ``HumanMotion``.

    Attributes:
        robot: the robot that moves; joints that the motion does not name stay at home.
        motion: its motion; missing contacts are detected as for a person.
        profile: its profile; None: a bundled one or a guess.
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
        if self.robot.floating_base != self.motion.is_free:
            raise OsikValueError(
                f"the base of the motion {'moves' if self.motion.is_free else 'is fixed'}: load the robot with "
                f"floating_base={self.motion.is_free}"
            )
        known = joints_in_mujoco_order(self.robot)
        for name in self.motion.joint_names:
            if name not in known:
                raise unknown_name("joint", name, known)
        profile = find_profile(self.robot) if self.profile is None else self.profile
        check_profile(self.robot, profile)
        object.__setattr__(self, "profile", profile)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], robot: Robot, *, profile: Profile | None = None, fps: float | None = None
    ) -> SourceMotion:
        """Read a robot's motion, ``motion.npz`` or a CSV.

        Args:
            path: the file; a CSV has the robot's joints in MuJoCo's order.
            robot: the robot that moves.
            profile: its profile; None: a bundled one or a guess.
            fps: frame rate of a CSV [1/s]; not with a ``.npz``, which contains it.

        Raises:
            FileNotFoundError, ValueError, KeyError: as of ``RobotMotion.load`` and ``SourceMotion``.
        """
        names = joints_in_mujoco_order(robot) if Path(path).suffix.lower() == ".csv" else None
        motion = RobotMotion.load(path, joint_names=names, fps=fps)
        return cls(robot, motion, profile, Path(path).stem)

    @property
    def fps(self) -> float:
        """Return the frame rate [1/s]."""
        return self.motion.fps

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return len(self.motion.qpos)

    @property
    def seen(self) -> Profile:
        """Return the robot's profile: the given one, or the one found for it."""
        assert self.profile is not None  # since it was made
        return self.profile

    def resampled(self, fps: float) -> SourceMotion:
        """Return the motion at another rate; see ``HumanMotion.resampled``."""
        return dataclasses.replace(self, motion=self.motion.resampled(fps))

    def person(self) -> Person:
        """Return the robot's motion as that of a person: limb directions, trunk and foot orientations, contacts."""
        profile, fps = self.seen, self.motion.fps
        home = np.asarray(self.robot.mujoco_qpos(facing_x(self.robot, profile.across).q0))
        found = find_places(self.robot, profile, np.concatenate([home[None], self._qpos(home)]))
        upright = {role: track[0] for role, track in found.keypoints.items()}
        ends = profile.standing if len(profile.feet) == 4 else [f"{side}_ankle" for side in SIDES]
        ankle = 0.0
        if profile.walks:
            ankle = float(np.mean([upright[role][2] for role in ends]) - found.soles[0, :, 2].mean())
        standing, contact = found.standing[1:], self.motion.contact
        down = np.zeros(3)
        points = {role: track[1:] for role, track in found.keypoints.items()}
        if profile.feet and contact is None:
            noise = find_noise(standing)
            down[2] = find_ground(standing, noise_steps(noise, fps))
            contact = find_contact(standing, fps, down[2], noise=noise)
        if len(profile.feet) == 2:
            points |= {role: standing[:, k] for k, role in enumerate(profile.standing)}
        points = {role: track - down for role, track in points.items()}
        turns = found.turns[1:] @ np.swapaxes(found.turns[0], -1, -2)
        if profile.is_hand:
            turns[:, :2] = palm_axes(points)[:, None]
        limbs = [limb for limb in (*LIMBS, *REACHES, *FINGER_REACHES) if set(limb) <= set(upright)]
        return Person(
            fps=fps,
            points=points,
            pelvis=turns[:, 0],
            torso=turns[:, 1],
            root=path_of(points),
            feet=turns[:, 2:],
            contact=np.zeros((self.frames, 4), bool) if contact is None else contact,
            lengths={limb: bone_length(upright, limb) for limb in limbs},
            ankle=ankle,
        )

    def _qpos(self, home: np.ndarray) -> np.ndarray:
        """Return the motion as configurations of the robot's MuJoCo model. (F, nq)."""
        model = self.robot.mj_model
        joints = [int(model.joint(name).qposadr[0]) for name in self.motion.joint_names]
        columns = [*base_columns(self.robot), *joints]
        qpos = np.tile(home, (self.frames, 1))
        qpos[:, columns] = self.motion.qpos
        return qpos
