"""Robots by name or file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from .._errors import OsikValueError
from ._messages import USER_ERRORS, CommandError, told

if TYPE_CHECKING:
    from ..robot import Robot

FLOATING = {"auto": None, "floating": True, "fixed": False}
"""Values of ``--base``: whether the root moves freely; None: as the file says."""


def read_robot(source: str, base: str = "auto") -> Robot:
    """Return a robot by a name that ``load_robot`` takes, or a URDF or MJCF file, told apart by what is in it.

    Raises:
        CommandError: no such file, or what is in it is broken.
    """
    from ..robot import Robot, load_robot
    from ..robot.loading import NAMES, ROBOTS, is_mjcf

    with told():
        if source in ROBOTS and not os.path.exists(source):
            if base != "auto":
                raise OsikValueError(f"--base goes with a file; {source} is what it is")
            return load_robot(source)
        path, floating = Path(source), FLOATING[base]
        if not path.is_file():
            if source in NAMES or source.endswith("_description"):
                return _described(source, floating)
            raise FileNotFoundError(
                f"no such file: {source} (robots by name: {', '.join(NAMES)}; names of robot_descriptions end in "
                "_description)"
            )
        if is_mjcf(path):
            return Robot.from_mjcf(path, floating_base=floating)
        return Robot.from_urdf(path, floating_base=floating)


def _described(name: str, floating: bool | None) -> Robot:
    """Return a robot of robot_descriptions, whose git may fail in ways of its own."""
    from ..robot import load_robot

    try:
        return load_robot(name, floating_base=floating)
    except USER_ERRORS:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())
        raise CommandError(f"{name} could not be fetched: {type(error).__name__}: {reason}") from error
