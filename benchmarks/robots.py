"""The robots of the workload: URDFs of example-robot-data without their meshes, posed and measured by Pinocchio."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from .workload import Workload

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


def workload(name: str) -> Workload:
    """The standard workload on a robot.

    Raises:
        KeyError: no such robot.
    """
    if name not in ROBOTS:
        raise KeyError(f"no robot {name!r}; robots: {', '.join(ROBOTS)}")
    given = ROBOTS[name]
    urdf, floating = lean_urdf(given), bool(given.feet)
    model = pinocchio_model(urdf, floating)
    data = model.createData()
    base = 7 if floating else 0
    start = _standing(model, data, given)
    pin.framesForwardKinematics(model, data, start)
    com = pin.centerOfMass(model, data, start).copy()
    feet = [data.oMf[model.getFrameId(foot)].copy() for foot in given.feet]
    hand = data.oMf[model.getFrameId(given.hand)]
    goal = com.copy()
    if feet:
        goal[:2] = np.mean([foot.act(np.array([given.foot_centre, 0.0, 0.0])) for foot in feet], axis=0)[:2]
    return Workload(
        robot=name,
        urdf=urdf,
        floating=floating,
        root=given.root,
        joints=tuple(model.names)[2 if floating else 1 :],
        start=start,
        feet=given.feet,
        foot_positions=np.array([foot.translation for foot in feet]).reshape(-1, 3),
        foot_rotations=np.array([foot.rotation for foot in feet]).reshape(-1, 3, 3),
        hand=given.hand,
        hand_position=hand.translation.copy(),
        hand_rotation=hand.rotation.copy(),
        amplitude=np.array(given.amplitude),
        com_start=com,
        com_goal=goal,
        position_lower=model.lowerPositionLimit[base:].copy(),
        position_upper=model.upperPositionLimit[base:].copy(),
        velocity=model.velocityLimit[model.nv - (model.nq - base) :].copy(),
    )


def pinocchio_model(urdf: str, floating: bool) -> pin.Model:
    """Pinocchio's model of a URDF's text."""
    return pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromXML(urdf)


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


def _standing(model: pin.Model, data: pin.Data, given: Description) -> np.ndarray:
    """The start: the posture, with the lower foot at height 0."""
    q = pin.neutral(model)
    for joint, angle in given.posture.items():
        q[model.joints[model.getJointId(joint)].idx_q] = angle
    if given.feet:
        pin.framesForwardKinematics(model, data, q)
        q[2] -= min(data.oMf[model.getFrameId(foot)].translation[2] for foot in given.feet)
    return q
