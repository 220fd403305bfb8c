"""URDFs of MuJoCo's models, for the peers that read nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np


def urdf(model: mujoco.MjModel, frames: Collection[str] = ()) -> str:
    """A URDF of a model's kinematics and masses.

    Bodies become links, each with a hinge or a slide to its parent, or fixed to it. The first one is the root, wherever
    it stands, on a free joint or on none. Greatest speeds are the model's numerics ``velocity_limit/JOINT``, or 0.
    Shapes, actuators and equality constraints are left out.

    Args:
        model: with one tree.
        frames: names of sites that become links too.

    Raises:
        ValueError: several trees; a body has a joint of another kind, several, or one that is not at its origin.
    """
    if not (model.body_parentid[2:] > 0).all():
        raise ValueError(f"a URDF has one tree; this model has {int(np.sum(model.body_parentid[1:] == 0))}")
    robot = ElementTree.Element("robot", name="robot")
    for body in range(1, model.nbody):
        link = ElementTree.SubElement(robot, "link", name=model.body(body).name)
        if model.body_mass[body] > 0.0:
            _add_mass(link, model, body)
        if body > 1:
            _add_joint(robot, model, body)
    for name in frames:
        site = model.site(name)
        ElementTree.SubElement(robot, "link", name=name)
        joint = ElementTree.SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
        _connect(joint, model.body(site.bodyid[0]).name, name, site.pos, site.quat)
    return ElementTree.tostring(robot, encoding="unicode")


def keyframe(model: mujoco.MjModel) -> dict[str, float]:
    """Of each hinge and slide, where the first keyframe has it."""
    joints = [model.joint(i) for i in range(model.njnt) if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
    return {joint.name: float(model.key_qpos[0, joint.qposadr[0]]) for joint in joints}


def _add_mass(link: ElementTree.Element, model: mujoco.MjModel, body: int) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
    _add_origin(inertial, model.body_ipos[body], model.body_iquat[body])
    inertia = ElementTree.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0")
    for axis, moment in zip("xyz", model.body_inertia[body], strict=True):
        inertia.set(f"i{axis}{axis}", repr(float(moment)))


def _add_joint(robot: ElementTree.Element, model: mujoco.MjModel, body: int) -> None:
    parent, child = model.body(model.body_parentid[body]).name, model.body(body).name
    count, first = int(model.body_jntnum[body]), int(model.body_jntadr[body])
    if count == 0:
        joint = ElementTree.SubElement(robot, "joint", name=f"{child}_fixed", type="fixed")
    else:
        kinds: dict[Any, str] = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
        kind = kinds.get(mujoco.mjtJoint(int(model.jnt_type[first])))
        if count > 1 or kind is None or model.jnt_pos[first].any():
            raise ValueError(f"body {child!r} needs one hinge or slide at its origin, or none")
        name = model.joint(first).name
        joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "axis", xyz=_text(model.jnt_axis[first]))
        lower, upper = (repr(float(bound)) for bound in model.jnt_range[first])
        ElementTree.SubElement(joint, "limit", lower=lower, upper=upper, velocity=repr(_speed(model, name)), effort="0")
    _connect(joint, parent, child, model.body_pos[body], model.body_quat[body])


def _connect(joint: ElementTree.Element, parent: str, child: str, position: np.ndarray, quaternion: np.ndarray) -> None:
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    _add_origin(joint, position, quaternion)


def _add_origin(element: ElementTree.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    R = matrix.reshape(3, 3)
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    ElementTree.SubElement(element, "origin", xyz=_text(position), rpy=_text(np.array([roll, pitch, yaw])))


def _speed(model: mujoco.MjModel, joint: str) -> float:
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, f"velocity_limit/{joint}")
    return float(model.numeric_data[model.numeric_adr[numeric]]) if numeric >= 0 else 0.0


def _text(vector: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(vector).ravel())
