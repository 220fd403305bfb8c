"""Robots by a short name: those that come with this package, and those whose URDFs come with example-robot-data."""

from __future__ import annotations

import sys
from pathlib import Path

from ..._errors import unknown_name
from .._model import RobotModel
from ._descriptions import described
from ._embedded import EXAMPLES, ROBOTS, embedded
from ._options import LoadOptions
from ._urdf import from_urdf

ELSEWHERE = {"g1": "g1_mj_description", "talos": "talos_description"}
"""The same robots in robot_descriptions, taken where example-robot-data is not installed."""


def example_urdf(name: str) -> Path:
    """Return the URDF of one of ``EXAMPLES``, in the package example-robot-data.

    Raises:
        KeyError: no such robot.
        FileNotFoundError: example-robot-data is not installed.
    """
    if name not in EXAMPLES:
        raise unknown_name("robot", name, tuple(EXAMPLES))
    for folder in sys.path:
        for share in ("cmeel.prefix/share", "share"):
            found = Path(folder) / share / "example-robot-data" / "robots" / EXAMPLES[name][0]
            if found.is_file():
                return found
    raise FileNotFoundError(
        f"the URDF of {name} comes with example-robot-data (pip install example-robot-data), which is not installed; "
        "or give the path of a URDF of yours"
    )


def named(name: str, options: LoadOptions) -> RobotModel:
    """Return names and numbers of a robot by its name.

    Raises:
        FileNotFoundError: the robot is one of ``EXAMPLES``, and neither example-robot-data nor robot_descriptions is
            installed.
        ImportError, KeyError, ValueError: as ``described``.
    """
    if name in ROBOTS:
        return embedded(name, options)
    if name not in EXAMPLES:
        return described(name, options)
    try:
        if options.floating_base is None:
            options = options._replace(floating_base=EXAMPLES[name][1])
        return from_urdf(example_urdf(name), options)
    except FileNotFoundError as missing:
        if name not in ELSEWHERE:
            raise
        try:
            return described(ELSEWHERE[name], options)
        except ImportError:
            raise missing from None
