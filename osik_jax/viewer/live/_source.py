"""Source of a robot: the name or file that a session file stores in place of the robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ...robot import Robot, load_robot
from ...robot.loading import NAMES, is_mjcf

_SUFFIX = "_description"


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Robot given by name or file.

    Attributes:
        robot: a name that ``load_robot`` takes, or the path of a URDF or MJCF file.
        floating_base: as in ``Robot.from_urdf``; None: as the file says.
    """

    robot: str
    floating_base: bool | None = None

    @property
    def is_file(self) -> bool:
        """Return whether the source is a file rather than a name."""
        return Path(self.robot).is_file() or (self.robot not in NAMES and not self.robot.endswith(_SUFFIX))

    @property
    def is_mjcf(self) -> bool:
        """Return whether the source is an MJCF file."""
        return self.is_file and is_mjcf(self.robot)

    def python(self) -> str:
        """Return the expression that loads it, in a program with ``import osik_jax as osik``."""
        base = "" if self.floating_base is None else f", floating_base={self.floating_base}"
        if not self.is_file:
            return f"osik.load_robot({self.robot!r}{base})"
        return f"osik.Robot.{'from_mjcf' if self.is_mjcf else 'from_urdf'}({self.robot!r}{base})"


def load_source(source: RobotSource) -> Robot:
    """Return the robot of a source.

    Raises:
        FileNotFoundError: no such file.
        ImportError, KeyError, ValueError: as in ``load_robot``, ``Robot.from_urdf`` and ``Robot.from_mjcf``.
    """
    if not source.is_file:
        return load_robot(source.robot, floating_base=source.floating_base)
    if not Path(source.robot).is_file():
        raise FileNotFoundError(f"no such file: {source.robot}")
    load = Robot.from_mjcf if source.is_mjcf else Robot.from_urdf
    return load(source.robot, floating_base=source.floating_base)
