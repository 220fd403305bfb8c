"""Robots that come with the package: MJCF files under ``osik_jax/robot/models``."""

from __future__ import annotations

from importlib import resources

from .._model import RobotModel
from ._mjcf import from_mjcf
from ._options import LoadOptions

ROBOTS = ("nao", "arm7")
EXAMPLES = {
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True),
    "talos": ("talos_data/robots/talos_full_v2.urdf", True),
    "go2": ("go2_description/urdf/go2.urdf", True),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False),
    "panda": ("panda_description/urdf/panda.urdf", False),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", False),
    "so101": ("so_arm_description/urdf/so101.urdf", False),
    "baxter": ("baxter_description/urdf/baxter.urdf", False),
    "tiago": ("tiago_description/robots/tiago.urdf", False),
    "allegro": ("allegro_hand_description/urdf/allegro_right_hand.urdf", False),
}
"""Robots of the package example-robot-data: the URDF's path below its ``robots``, and whether the base floats."""
NAMES = (*ROBOTS, *EXAMPLES)
"""Names that ``load_robot`` and every command take, beside those of robot_descriptions."""


def embedded(name: str, options: LoadOptions) -> RobotModel:
    """Return names and numbers of an embedded robot, one of ``ROBOTS``."""
    text = (resources.files("osik_jax") / "robot" / "models" / f"{name}.xml").read_text(encoding="utf-8")
    return from_mjcf(text, options)
