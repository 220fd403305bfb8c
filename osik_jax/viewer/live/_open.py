"""Pages of ``osik view`` for a robot and for a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ..._errors import OsikValueError, warn
from ..._npz import open_npz
from ...reachability import load_map
from ...robot import Robot
from .._parts import robot_parts
from ._default import default_session
from ._page import LiveView, serve
from ._reach import ReachView, check_map, serve_reach
from ._source import RobotSource
from ._stance import sole_polygon, standing


def open_robot(robot: Robot, source: RobotSource, feet: Sequence[str], *, host: str, port: int) -> LiveView:
    """Open a page with a robot to drag; ``feet`` are the frames that stand on the ground."""
    for foot in feet:
        robot.tree.frame(foot)
    shapes, look = robot_parts(robot), robot.holder.look
    if look is not None and look.read.missing:
        warn(f"the page does without mesh files that cannot be read: {', '.join(look.read.missing[:3])}")
    q = standing(robot, shapes, feet) if robot.floating_base else np.asarray(robot.q0)
    polygon = sole_polygon(robot, shapes, q, feet) if feet else None
    session = default_session(robot, q=jnp.asarray(q), feet=feet, polygon=polygon, source=source)
    return serve(session, host=host, port=port)


def is_map(path: Path) -> bool:
    """Return whether a file is a map of ``osik reach`` rather than a motion."""
    try:
        with open_npz(path) as file:
            return "reached" in file.files
    except (OSError, ValueError):
        return False  # what is wrong with it is told where it is read


def open_map(path: Path, robot: Robot, *, host: str, port: int) -> ReachView:
    """Open a page with a reachability map."""
    found = load_map(path)
    try:
        check_map(robot, found)
    except ValueError as error:
        raise OsikValueError(f"{path}: {error}; say which with --robot") from None
    return serve_reach(robot, found, host=host, port=port)
