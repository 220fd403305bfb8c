"""The robots that are measured, in every benchmark: where they come from, how they stand, what they move."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field

from .workload import Costs

_LEG = {"hip_pitch": -0.35, "knee": 0.7, "ankle_pitch": -0.35}


@dataclass(frozen=True)
class Description:
    """What the benchmarks need to know about a robot.

    Attributes:
        root: link that the base is.
        hand: link that moves.
        amplitude: of its curve [m].
        feet: links that stay, and carry the robot.
        foot_centre: of a foot's contact area, ahead of its link [m].
        sole: corners of a foot's contact area in its frame [m]; empty if the file has them.
        arms: parts of the names of the joints that differ from lane to lane in ``benchmarks.throughput``.
        urdf: end of the file's path in example-robot-data; empty for an embedded robot.
        posture: joints of the start that are not 0 [rad]; an embedded robot has a keyframe.
        removed: joints that are fixed at 0.
        costs: square roots of the weights of ``python -m benchmarks``. Where the posture pulls harder, the exact answer
            strays further, and a bound of the judge says less.
    """

    root: str
    hand: str
    amplitude: tuple[float, float, float]
    feet: tuple[str, ...] = ()
    foot_centre: float = 0.0
    sole: tuple[tuple[float, float, float], ...] = ()
    arms: tuple[str, ...] = ()
    urdf: str = ""
    posture: Mapping[str, float] = field(default_factory=dict)
    removed: tuple[str, ...] = ()
    costs: Costs = field(default_factory=Costs)


ROBOTS = {
    "g1": Description(
        root="pelvis",
        hand="right_wrist_yaw_link",
        amplitude=(0.10, 0.12, 0.10),
        feet=("left_ankle_roll_link", "right_ankle_roll_link"),
        foot_centre=0.035,
        sole=tuple((x, y, 0.0) for x in (-0.05, 0.11) for y in (-0.03, 0.03)),
        arms=("shoulder", "elbow"),
        urdf="g1_description/urdf/g1_29dof_rev_1_0.urdf",
        posture={f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in _LEG.items()}
        | dict(left_shoulder_roll_joint=0.2, right_shoulder_roll_joint=-0.2, right_shoulder_pitch_joint=-0.3)
        | dict(left_elbow_joint=0.6, right_elbow_joint=0.6),
    ),
    "nao": Description(
        root="torso",
        hand="l_gripper",
        amplitude=(0.02, 0.03, 0.03),
        feet=("l_sole", "r_sole"),
        foot_centre=0.02,
        arms=("Shoulder", "Elbow"),
        costs=Costs(posture=0.02),
    ),
    "arm7": Description(
        root="link0",
        hand="hand",
        amplitude=(0.07, 0.08, 0.07),
        arms=("joint",),
    ),
    "panda": Description(
        root="panda_link0",
        hand="panda_link8",
        amplitude=(0.07, 0.08, 0.07),
        arms=("joint",),
        urdf="panda_description/urdf/panda.urdf",
        posture=dict(panda_joint2=-0.5, panda_joint4=-2.0, panda_joint6=1.6, panda_joint7=0.8),
        removed=("panda_finger_joint1", "panda_finger_joint2"),
    ),
}


def lean_urdf(given: Description) -> str:
    """The text of a URDF of example-robot-data, without shapes, meshes and what is not standard; some joints fixed."""
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
