"""The standard workload on a robot, posed and measured by Pinocchio.

    python -m benchmarks.robots g1 g1.json

writes it to a file, for ``python -m benchmarks --workload g1.json`` on a machine without Pinocchio.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

from .descriptions import ROBOTS, lean_urdf
from .processes import ROOT
from .urdf import keyframe, urdf
from .workload import Workload


def workload(name: str) -> Workload:
    """The standard workload on a robot.

    Raises:
        KeyError: no such robot.
    """
    if name not in ROBOTS:
        raise KeyError(f"no robot {name!r}; robots: {', '.join(ROBOTS)}")
    given = ROBOTS[name]
    text, posture = _source(name)
    floating = bool(given.feet)
    model = pinocchio_model(text, floating)
    data = model.createData()
    base = 7 if floating else 0
    start = _standing(model, data, posture, given.feet)
    pin.framesForwardKinematics(model, data, start)
    com = pin.centerOfMass(model, data, start).copy()
    feet = [data.oMf[model.getFrameId(foot)].copy() for foot in given.feet]
    hand = data.oMf[model.getFrameId(given.hand)]
    goal = com.copy()
    if feet:
        goal[:2] = np.mean([foot.act(np.array([given.foot_centre, 0.0, 0.0])) for foot in feet], axis=0)[:2]
    return Workload(
        robot=name,
        urdf=text,
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
        costs=given.costs,
    )


def pinocchio_model(urdf: str, floating: bool) -> pin.Model:
    """Pinocchio's model of a URDF's text."""
    return pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromXML(urdf)


def _source(name: str) -> tuple[str, Mapping[str, float]]:
    """A URDF and the posture of the start; of an embedded robot, without its mimic joints, which the peers lack."""
    given = ROBOTS[name]
    if given.urdf:
        return lean_urdf(given), given.posture
    model = mujoco.MjModel.from_xml_path(str(ROOT / "osik_jax" / "robot" / "models" / f"{name}.xml"))
    links = {model.body(i).name for i in range(model.nbody)}
    return urdf(model, [frame for frame in (*given.feet, given.hand) if frame not in links]), keyframe(model)


def _standing(model: pin.Model, data: pin.Data, posture: Mapping[str, float], feet: tuple[str, ...]) -> np.ndarray:
    """The start: the posture, with the lower foot at height 0."""
    q = pin.neutral(model)
    for joint, angle in posture.items():
        q[model.joints[model.getJointId(joint)].idx_q] = angle
    if feet:
        pin.framesForwardKinematics(model, data, q)
        q[2] -= min(data.oMf[model.getFrameId(foot)].translation[2] for foot in feet)
    return q


def main() -> None:
    """Writes a workload."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("robot", choices=sorted(ROBOTS))
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    given.file.write_text(workload(given.robot).to_json(), encoding="utf-8")


if __name__ == "__main__":
    main()
