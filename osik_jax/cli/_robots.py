"""Robots by name or file."""

from __future__ import annotations

import os
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
