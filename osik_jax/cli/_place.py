"""``osik place``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ._inputs import read_pose_file, read_robot
from ._messages import CommandError, told, writing

if TYPE_CHECKING:
    from ..collision import Scene


@dataclasses.dataclass(frozen=True)
class Place:
    """Finds where to put a robot's base so that a frame reaches all poses of a CSV file, free of a scene.

    Prints the best base and what stops the robot at poses that it does not reach. Writes placement.json and
    placement.png. The exit code is 1 if no base reaches all poses.
    """

    robot: str
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    frame: str
    """The frame: a link, body, site or geom, carried by hinges and slides."""
    poses: Path
    """CSV file, a row a pose: x,y,z,qw,qx,qy,qz or x,y,z, world axes [m]. A head with these names may come first."""
    x: tuple[float, float, int]
    """First and last coordinate of the bases [m], and how many: -1 1 11."""
    y: tuple[float, float, int]
    """First and last coordinate of the bases [m], and how many."""
    yaw: int = 8
    """Number of rotations of the base about the vertical."""
    height: float = 0.0
    """Height of the base above the world's origin [m]."""
    scene: Path | None = None
    """Obstacles: MuJoCo XML, URDF, or MoveIt's .yaml or .scene."""
    clearance: float = 0.0
    """Smallest distance of all pairs of shapes [m]."""
    allow: tuple[str, ...] = ()
    """OBJECT:LINK of the scene and the robot that may touch, such as floor:base_link."""
    joints: tuple[str, ...] = ()
    """NAME=VALUE of joints that do not move the frame, such as an open gripper [rad or m]."""
    out: Path = Path("osik-placement")
    """Folder for the files."""
    base: Literal["auto", "floating", "fixed"] = "fixed"
    """The robot's root, as the file says with auto; a base that is placed does not move freely."""

    def run(self) -> int:
        """Run the command; return the exit code."""
        from ..placement import place_base
        from ..robot.loading import ROBOTS

        robot = read_robot(self.robot, "auto" if self.robot in ROBOTS else self.base)
        with told():
            found = place_base(
                robot,
                {self.frame: read_pose_file(self.poses)},
                x=np.linspace(*self.x),
                y=np.linspace(*self.y),
                yaw=self.yaw,
                height=self.height,
                scene=self._read_scene(),
                clearance=self.clearance,
                q0=robot.configuration(dict(_split(text, "=", float) for text in self.joints)),
            )
        print(found.explain())
        with told(), writing(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
            base = dict(zip(("x", "y", "yaw", "height"), found.best.tolist(), strict=True))
            q = [row.tolist() if ok else None for row, ok in zip(found.q, found.is_reached, strict=True)]
            (self.out / "placement.json").write_text(json.dumps({"base": base, "q": q}, indent=1), encoding="utf-8")
            found.figure().savefig(self.out / "placement.png")
        print(f"written: {self.out}/placement.json, placement.png")
        return 0 if found.is_reached.all() else 1

    def _read_scene(self) -> Scene | None:
        from ..collision import Scene

        scene = None if self.scene is None else Scene.from_file(self.scene)
        return scene if scene is None else scene.allow(*(_split(text, ":", str) for text in self.allow))


def _split(text: str, mark: str, kind: type) -> tuple[str, Any]:
    """Return both parts of an argument."""
    name, _, value = text.partition(mark)
    try:
        return name, kind(value)
    except ValueError:
        raise CommandError(f"{text}: it is NAME{mark}VALUE") from None
