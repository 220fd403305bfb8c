"""The standard workload on a robot, posed and measured by Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from .descriptions import ROBOTS, Description, lean_urdf
from .workload import Workload


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


def _standing(model: pin.Model, data: pin.Data, given: Description) -> np.ndarray:
    """The start: the posture, with the lower foot at height 0."""
    q = pin.neutral(model)
    for joint, angle in given.posture.items():
        q[model.joints[model.getJointId(joint)].idx_q] = angle
    if given.feet:
        pin.framesForwardKinematics(model, data, q)
        q[2] -= min(data.oMf[model.getFrameId(foot)].translation[2] for foot in given.feet)
    return q
