"""Base class of clip and stream retargeting: the robot, its profile and its limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .._errors import OsikValueError
from ..limits import AccelerationLimit, ConfigurationLimit, VelocityLimit
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._body import Build, pairs_apart
from ._facing import facing_x
from ._motion import HumanMotion
from ._profile import Limb, Profile
from ._profile_file import check_profile, find_profile
from ._roles import chain
from ._skeletons import find_roles
from ._source_motion import SourceMotion
from ._terms import Body

ACCELERATION = 240.0


class OnRobot:
    """Robot with profile, limits and derived data, computed once for all clips.

    Arguments and errors are those of ``Retargeter``.

    Attributes:
        robot: the robot, with its home turned to face x if necessary.
        profile: its profile.
        balance: as given.
        limits: limits of position, speed and acceleration, which hold exactly.
    """

    def __init__(
        self, robot: Robot, profile: Profile | None, acceleration: float | Mapping[str, float], balance: float | None
    ):
        if balance is not None and not (np.isfinite(balance) and balance >= 0.0):
            raise OsikValueError(f"balance is {balance}; it is a length in metres, 0 or more")
        self.balance = balance
        self.profile = find_profile(robot) if profile is None else profile
        check_profile(robot, self.profile)
        if robot.floating_base and not self.profile.feet:
            raise OsikValueError(
                "nothing holds the robot's base: the profile has no feet. Load the robot with floating_base=False, or "
                "give the profile feet; those of a base on wheels have rolls = true"
            )
        if balance is not None and not (self.profile.walks and robot.floating_base):
            raise OsikValueError("balance is that of a robot on feet; this one has no legs that walk")
        robot = self.robot = facing_x(robot, self.profile.across)
        self.limits = ConfigurationLimit(robot), VelocityLimit(robot), _on_joints(robot, acceleration)
        self._acceleration = np.asarray(self.limits[2].acceleration)
        self._pairs = pairs_apart(robot, self.profile)
        self._set_profile(self.profile)

    def _set_profile(self, profile: Profile) -> None:
        """Set the profile, and the data derived from its keypoints."""
        self.profile, self._build = profile, Build.of(self.robot, profile)
        self._body = Body.of(self.robot, profile, self._pairs, self.balance)
        self._bodies: dict[tuple[Limb, ...], Body] = {(): self._body}

    def _body_that(self, touching: tuple[Limb, ...]) -> Body:
        """Return the body data for motions that hold these pairs, made once for each set of pairs."""
        if touching not in self._bodies:
            self._bodies[touching] = Body.of(self.robot, self.profile, self._pairs, self.balance, touching)
        return self._bodies[touching]

    def _roles(self, motion: HumanMotion | SourceMotion, mapping: Mapping[str, str] | None) -> dict[str, str]:
        """Return the clip's joint for each role (empty for a robot's motion), or raise if a needed role is missing."""
        limbs = [chain(limb) if self.profile.is_hand else limb for limb in self.profile.followed]
        needed = tuple(dict.fromkeys(role for limb in limbs for role in limb))
        if isinstance(motion, HumanMotion):
            return find_roles(motion.joint_names, mapping, needed, motion.positions)
        if mapping is not None:
            raise OsikValueError("mapping names joints of a person's clip; a robot's motion has those of its profile")
        roles = dict.fromkeys(role for limb in self.profile.followed for role in limb)
        missing = [role for role in roles if role not in motion.seen.keypoints]
        if missing:
            text = f"the robot that is followed has no {', '.join(missing)}; give a profile without these keypoints"
            raise OsikValueError(text)
        if self.profile.walks and motion.seen.standing != self.profile.standing:
            count, other = len(self.profile.feet), len(motion.seen.feet)
            raise OsikValueError(f"{count} feet cannot follow {other}: they walk otherwise")
        return {}


def _on_joints(robot: Robot, acceleration: float | Mapping[str, float]) -> AccelerationLimit:
    """Return the acceleration limit of the joints, at most the robot's own; the base is free."""
    if isinstance(acceleration, Mapping):
        return AccelerationLimit(robot, acceleration)
    if not acceleration > 0.0:
        raise OsikValueError(f"acceleration is {acceleration}; it has to be more than 0")
    given = np.where(scalar_layout(robot)[0], acceleration, np.inf)
    return AccelerationLimit(robot, np.minimum(given, np.asarray(robot.acceleration_limit)))
