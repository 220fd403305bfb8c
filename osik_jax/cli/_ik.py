"""``osik ik``."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import tyro

from ._inputs import HasBase, InScene, read_robot
from ._messages import CommandError, told


@dataclasses.dataclass(frozen=True)
class Ik(HasBase, InScene):
    """Finds a configuration that brings a frame to a pose, and prints it; or says what stops the robot.

    The exit code is 1 where none is found.
    """

    robot: Annotated[str, tyro.conf.Positional]
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    frame: str
    """The frame: a link, body, site or geom."""
    position: tuple[float, float, float]
    """Wanted position of the frame's origin, in world axes [m]."""
    quaternion: tuple[float, float, float, float] | None = None
    """Wanted orientation as a quaternion w x y z. Default: any."""
    hold: tuple[str, ...] = ()
    """Frames that stay where they are at the robot's home configuration, such as feet."""
    nearest: bool = False
    """Return the solution that is nearest to the home configuration."""
    all: bool = False
    """Print all solutions that differ."""
    seeds: int | None = None
    """Number of searches. Default: 64; with --nearest and --all up to 256, by the number of joints."""
    key: int = 0
    """Number of the sequence of their starts."""
    position_tolerance: float = 1e-3
    """Largest distance from the position [m]."""
    orientation_tolerance: float = 1e-2
    """Largest angle to the orientation [rad]."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from rich.console import Console

        from ..inverse import inverse_kinematics
        from ..inverse._report import print_found
        from ..kinematics._forward import home_kinematics

        if self.frame in self.hold:
            raise CommandError(f"--frame and --hold both name {self.frame!r}: a frame is moved or held")
        robot = read_robot(self.robot, self.base)
        with told():
            home = home_kinematics(robot)
            held: dict[str, Any] = {name: home.frame_pose(robot, name) for name in self.hold}
            turned = self.quaternion is not None
            wanted = {self.frame: (self.position, self.quaternion) if turned else self.position}
            found = inverse_kinematics(
                robot,
                held | wanted,
                seeds=self.seeds,
                key=self.key,
                nearest=self.nearest,
                all=self.all,
                position_tolerance=self.position_tolerance,
                orientation_tolerance=self.orientation_tolerance,
                **self.obstacles(),
            )
        print_found(Console(), robot, found)
        return 0 if found.converged else 1
