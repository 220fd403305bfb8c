"""Inputs that several commands take: robots by name or file, obstacles, and poses in CSV files."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .._errors import OsikValueError
from ..numerics._columns import read_columns
from ._messages import USER_ERRORS, CommandError, refuse, told

if TYPE_CHECKING:
    from ..robot import Robot

FLOATING = {"auto": None, "floating": True, "fixed": False}
"""Values of ``--base``: whether the root moves freely; None: as the file says."""
_POSITION, _POSE = ("x", "y", "z"), ("x", "y", "z", "qw", "qx", "qy", "qz")


def read_robot(source: str, base: str = "auto") -> Robot:
    """Return a robot by a name that ``load_robot`` takes, or a URDF or MJCF file, told apart by its content."""
    from ..robot import _load_robot
    from ..robot.loading import ROBOTS

    with told():
        if base != "auto" and source in ROBOTS and not os.path.exists(source):
            raise OsikValueError(f"--base goes with a file; {source} is what it is")
        try:
            return _load_robot.read_robot(source, floating_base=FLOATING[base])
        except USER_ERRORS:
            raise
        except Exception as error:
            if _load_robot.is_file(source):
                raise
            # robot_descriptions: its git may fail in ways of its own
            reason = " ".join(str(error).split())
            raise CommandError(f"{source} could not be fetched: {type(error).__name__}: {reason}") from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class HasBase:
    """The option of commands that read a robot from a file: its base."""

    base: Literal["auto", "floating", "fixed"] = "auto"
    """The root; floating: it moves freely; auto: as the file says. A URDF that does not say floats if it has feet."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InScene:
    """Obstacles, and what may touch."""

    scene: Path | None = None
    """File of obstacles that the robot keeps off, and off itself: .xml, .urdf, .yaml or .scene."""
    srdf: Path | None = None
    """With --scene: an SRDF, whose pairs may touch."""
    clearance: float = 0.0
    """With --scene: least distance of all shapes [m]."""

    def obstacles(self) -> dict[str, Any]:
        """Return the arguments of a function that takes a scene; none without one."""
        from ..collision import Scene

        refuse(self, self.scene is None, ("srdf", "clearance"), "--scene")
        if self.scene is None:
            return {}
        return dict(scene=Scene.from_file(self.scene), srdf=self.srdf, clearance=self.clearance)


def read_pose_file(path: Path) -> Any:
    """Return the positions of a file, and the quaternions w x y z if it has them; without a head in this order."""
    columns = read_columns(path, _POSE)
    if set(columns) not in (set(_POSITION), set(_POSE)):
        raise OsikValueError(f"{path}: its columns are {','.join(columns)}; they are x,y,z or x,y,z,qw,qx,qy,qz")
    rows = np.stack([columns[name] for name in _POSE if name in columns], -1)
    return rows if len(columns) == 3 else (rows[:, :3], rows[:, 3:])
