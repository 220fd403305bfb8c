"""``osik follow``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from ._messages import told
from ._pose_file import read_pose_file
from ._robots import read_robot
from ._scene import InScene


@dataclasses.dataclass(frozen=True)
class Follow(InScene):
    """Leads a frame of a robot along the poses of a CSV file, within limits, and writes the timed motion.

    The file has a row a pose: x,y,z,qw,qx,qy,qz or x,y,z, world axes [m]. A head with these names may come first.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """The CSV file."""
    robot: str
    """A URDF or MJCF file, or a robot by name."""
    frame: str
    """The frame: a link, body, site or geom."""
    out: Path = Path("motion.npz")
    """File to write: .npz, .csv or .parquet."""
    film: Path | None = None
    """Film to write: .gif, or .mp4 with ffmpeg."""
    picture: Path | None = None
    """Picture to write, of speeds and accelerations beside their limits."""
    dt: float = 0.001
    """Time between two samples [s]."""
    speed: float | None = None
    """Wanted speed of the frame [m/s], lowered where joints do not allow it. Default: as fast as possible."""
    acceleration: float = 5.0
    """Limit of all joints' accelerations [rad/s^2 or m/s^2]."""
    jerk: float | None = None
    """Limit of all joints' jerks [rad/s^3 or m/s^3]. Default: none."""
    free: Literal["x", "y", "z"] | None = None
    """Axis of the frame about which it may turn."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from ..motion import draw_motion, film_motion, follow

        robot = read_robot(self.robot, "auto")
        with told():
            found = follow(
                robot,
                {self.frame: read_pose_file(self.path)},
                free=None if self.free is None else {self.frame: self.free},
                speed=self.speed,
                acceleration=self.acceleration,
                jerk=self.jerk,
                **self.obstacles(),
            )
            motion, limits = found.sample(self.dt), np.asarray(found.timings[0].limits)
            motion.save(self.out)
            if self.picture is not None:
                draw_motion(motion, self.picture, limits)
            if self.film is not None:
                film_motion(motion, robot, self.film, limits, trails=[self.frame])
        print(
            f"{found.duration:.3f} s, at most {1e3 * found.position_error:.2g} mm and "
            f"{found.orientation_error:.2g} rad off the path; written to {self.out}"
        )
        for part in found.slow_parts() if self.speed is not None else ():
            print(f"slower from {part.start:.2f} to {part.end:.2f} s: {part.joint} is near its limit of {part.limit}")
        return 0
