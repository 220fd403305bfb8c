"""Source of a robot: the name or file that a session file stores in place of the robot."""

from __future__ import annotations

import dataclasses

from ...robot import Robot
from ...robot._load_robot import is_file, read_robot
from ...robot.loading import is_mjcf


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Robot given by name or file.

    Attributes:
        robot: a name that ``load_robot`` takes, or the path of a URDF or MJCF file.
        floating_base: as in ``Robot.from_urdf``; None: as the file says.
    """

    robot: str
    floating_base: bool | None = None

    def load(self) -> Robot:
        """Return the robot."""
        return read_robot(self.robot, floating_base=self.floating_base)

    def python(self) -> str:
        """Return the expression that loads it, in a program with ``import osik_jax as osik``."""
        base = "" if self.floating_base is None else f", floating_base={self.floating_base}"
        if not is_file(self.robot):
            return f"osik.load_robot({self.robot!r}{base})"
        return f"osik.Robot.{'from_mjcf' if is_mjcf(self.robot) else 'from_urdf'}({self.robot!r}{base})"
