"""Robots that come with the package: MJCF files under ``osik_jax/robot/models``."""

from __future__ import annotations

from importlib import resources

from .._model import RobotModel
from ._mjcf import from_mjcf
from ._options import LoadOptions

ROBOTS = ("nao", "arm7")
EXAMPLES = ("g1", "talos")
"""Unitree's G1 with 29 joints, and PAL's Talos, whose URDFs come with the package example-robot-data."""
NAMES = (*ROBOTS, *EXAMPLES)
"""Names that ``load_robot`` and every command take, beside those of robot_descriptions."""


def embedded(name: str, options: LoadOptions) -> RobotModel:
    """Names and numbers of an embedded robot, one of ``ROBOTS``."""
    text = (resources.files("osik_jax") / "robot" / "models" / f"{name}.xml").read_text(encoding="utf-8")
    return from_mjcf(text, options)
