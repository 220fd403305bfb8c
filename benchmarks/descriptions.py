"""The robots that are measured: URDFs of example-robot-data without their meshes, and the postures they start in."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field

_LEG = {"hip_pitch": -0.35, "knee": 0.7, "ankle_pitch": -0.35}


@dataclass(frozen=True)
class Description:
    """What the workload needs to know about a robot.

    Attributes:
        urdf: end of the file's path in example-robot-data.
        root: link that the base is.
        hand: link that moves.
        amplitude: of its curve [m].
        feet: links that stay, and carry the robot.
        foot_centre: of a foot's contact area, ahead of its link [m].
        posture: joints of the start that are not 0 [rad].
        removed: joints that are fixed at 0.
    """

    urdf: str
    root: str
    hand: str
    amplitude: tuple[float, float, float]
    feet: tuple[str, ...] = ()
    foot_centre: float = 0.0
    posture: Mapping[str, float] = field(default_factory=dict)
    removed: tuple[str, ...] = ()


ROBOTS = {
    "g1": Description(
        urdf="g1_description/urdf/g1_29dof_rev_1_0.urdf",
        root="pelvis",
        hand="right_wrist_yaw_link",
        amplitude=(0.10, 0.12, 0.10),
        feet=("left_ankle_roll_link", "right_ankle_roll_link"),
        foot_centre=0.035,
        posture={f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in _LEG.items()}
        | dict(left_shoulder_roll_joint=0.2, right_shoulder_roll_joint=-0.2, right_shoulder_pitch_joint=-0.3)
        | dict(left_elbow_joint=0.6, right_elbow_joint=0.6),
    ),
    "panda": Description(
        urdf="panda_description/urdf/panda.urdf",
        root="panda_link0",
        hand="panda_link8",
        amplitude=(0.10, 0.12, 0.10),
        posture=dict(panda_joint2=-0.5, panda_joint4=-2.0, panda_joint6=1.6, panda_joint7=0.8),
        removed=("panda_finger_joint1", "panda_finger_joint2"),
    ),
}


def lean_urdf(given: Description) -> str:
    """The URDF's text without shapes, meshes and what is not standard; some joints fixed."""
    files = importlib.metadata.files("example-robot-data") or []
    (path,) = [file.locate() for file in files if str(file).endswith(given.urdf)]
    root = ElementTree.parse(str(path)).getroot()
    for child in list(root):
        if child.tag not in ("link", "joint"):
            root.remove(child)
        for part in list(child):
            if part.tag in ("visual", "collision", "mimic", "safety_controller"):
                child.remove(part)
        if child.tag == "joint" and child.get("name") in given.removed:
            child.set("type", "fixed")
    return ElementTree.tostring(root, encoding="unicode")
