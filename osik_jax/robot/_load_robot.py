"""Robots by name: of this package, example-robot-data and robot_descriptions."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._errors import OsikKeyError, OsikTypeError
from . import loading
from ._configuration import Home
from ._robot import Robot
from .loading import LoadOptions, LockedJoints, PositionLimits

_OF_FILES = (".urdf", ".xml", ".mjcf")
"""Endings of names that are paths."""


def load_robot(
    name: str,
    *,
    floating_base: bool | None = None,
    velocity_limits: Mapping[str, float] | None = None,
    position_limits: PositionLimits | None = None,
    locked_joints: LockedJoints = (),
    home: Home | None = None,
    root: str | Sequence[str] | None = None,
) -> Robot:
    """Load an embedded robot: ``"nao"`` (floating base, 26 joints) or ``"arm7"`` (7 joints, fixed base).

    ``"g1"``, ``"talos"``, ``"go2"`` (floating base), ``"ur5"``, ``"panda"``, ``"xarm7"``, ``"so101"``, ``"baxter"``,
    ``"tiago"`` and ``"allegro"`` (fixed base) are URDFs of the package example-robot-data, which has to be installed.
    Without it, ``"g1"`` and ``"talos"`` are taken from robot_descriptions. All commands of ``osik`` take these names.

    Any other name is one of the package robot_descriptions (the extra ``descriptions``): MuJoCo Menagerie as
    ``panda_mj_description``, ``g1_mj_description`` and so on, URDFs as ``panda_description``. That package clones the
    robot's git repository into a cache when it is asked for the first time.

    Args:
        name: of the robot.
        floating_base: as in ``Robot.from_mjcf`` and, for URDFs, ``Robot.from_urdf``.
        velocity_limits: likewise.
        position_limits: likewise.
        locked_joints: likewise.
        home: likewise.
        root: likewise.

    Raises:
        KeyError: no such robot; the message lists those with names like it, and of a path says what reads files. No
            such joint or keyframe.
        ImportError: the robot is one of robot_descriptions, which is not installed.
        FileNotFoundError: the robot's URDF comes with a package that is not installed.
        ValueError: the robot comes as xacro alone, its file cannot be read, or ``home`` does not fit.

    Warns:
        OsikWarning: as in ``Robot.from_mjcf`` and ``Robot.from_urdf``.
    """
    if not isinstance(name, str):
        raise OsikTypeError(f"name is {name!r}; it is a name, such as {' or '.join(map(repr, loading.ROBOTS))}")
    if os.sep in name or name.lower().endswith(_OF_FILES):
        raise OsikKeyError(
            f"no robot {name!r}: load_robot takes names ({', '.join(loading.NAMES)}, or one of robot_descriptions); "
            "files are read by Robot.from_urdf(path) and Robot.from_mjcf(path)"
        )
    options = LoadOptions(
        floating_base=floating_base,
        velocity_limits=velocity_limits,
        position_limits=position_limits,
        locked_joints=locked_joints,
        root=root,
        has_home=home is not None,
    )
    return Robot._of(loading.named(name, options), home)


def is_file(source: str) -> bool:
    """Return whether the source of a robot is a file rather than a name that ``load_robot`` takes."""
    return Path(source).is_file() or not (source in loading.NAMES or source.endswith("_description"))


def read_robot(source: str, **options: Any) -> Robot:
    """Return a robot by its name, or from a URDF or MJCF file, told apart by its content.

    ``options`` and errors are those of ``load_robot``; a file that does not exist raises FileNotFoundError.
    """
    if not is_file(source):
        return load_robot(source, **options)
    if not Path(source).is_file():
        raise FileNotFoundError(
            f"no such file: {source} (robots by name: {', '.join(loading.NAMES)}; names of robot_descriptions end in "
            "_description)"
        )
    return (Robot.from_mjcf if loading.is_mjcf(source) else Robot.from_urdf)(source, **options)
