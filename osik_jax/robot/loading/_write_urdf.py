"""Writer of URDF text from a robot's leaves."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np

from ..._errors import OsikValueError
from .._describe import model_name
from .._model import RobotModel
from .._tree import BALL, FREE, SLIDE
from ._followers import free_name
from ._mjmodel import LEAST_INERTIA
from ._poses import IDENTITY, Pose
from ._write import frame_pose, motion_to, one_for_all, other_frames, placed_joints, pose_of, put, refuse_stack

_UNLIMITED = 1e9
"""Written for an infinite limit of a slide or of one side: URDF has no word for it."""
_AROUND = {int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere", int(mujoco.mjtGeom.mjGEOM_BOX): "box"}
_ALONG = {int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}


def to_urdf(robot: RobotModel) -> str:
    """Return the robot as URDF; see ``Robot.to_urdf``."""
    refuse_stack(robot)
    tree = robot.tree
    root = ElementTree.Element("robot", name=model_name(robot) or "robot")
    links = {name: put(root, "link", name=name) for name in tree.body_names}
    for body, name in enumerate(tree.body_names):
        if body:
            _add_inertial(robot, body, links[name])
            _add_body(robot, body, root)
    done: dict[str, Pose] = {}
    for geom, body in enumerate(tree.geom_bodies):
        done |= _add_geom(robot, geom, links[tree.body_names[body]])
    for name, body, pose in other_frames(robot, done):
        put(root, "link", name=name)
        _add_joint(root, free_name(f"{name}_fixed", tree.joint_names), "fixed", tree.body_names[body], name, pose)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_body(robot: RobotModel, body: int, root: ElementTree.Element) -> None:
    """Write the joints that carry a body, with links between them where it has several or an anchor off its origin."""
    tree, (pose, joints) = robot.tree, placed_joints(robot, body)
    parent, name = tree.body_names[tree.body_parents[body]], tree.body_names[body]
    base = _base_link(robot) if tree.body_parents[body] == 0 else None
    if base is not None and not any(tree.joint_types[place.joint] == FREE for place in joints):
        parent, pose = tree.frame_names[base], _inverse(frame_pose(robot, base)) @ pose
    for place in joints:
        kind, own = tree.joint_types[place.joint], tree.joint_names[place.joint]
        if kind == BALL:
            raise OsikValueError(f"joint {own!r} is a ball joint: URDF has none. Write the robot by to_mjcf")
        if kind == FREE:
            _add_joint(root, own, "floating", parent, name, IDENTITY)
            return
        before = pose @ Pose(place.anchor, np.eye(3)) @ motion_to(robot, place, 0.0)  # where URDF has its origin
        pose = Pose(-place.anchor, np.eye(3))
        last = place is joints[-1] and not place.anchor.any()
        child = name if last else free_name(f"{name}_{own}", tree.frame_names)
        if not last:
            put(root, "link", name=child)
        element = _add_joint(root, own, _kind(robot, place.joint), parent, child, before)
        _add_moving(robot, place.joint, element, place.axis)
        parent = child
    if parent != name:
        _add_joint(root, free_name(f"{name}_fixed", tree.joint_names), "fixed", parent, name, pose)


def _base_link(robot: RobotModel) -> int | None:
    """Return the first frame that is fixed to the world, which carries the robot; None if there is none.

    A reader takes what hangs from one link as one robot, and what hangs from the world as several.
    """
    tree = robot.tree
    fixed = (k for k, body in enumerate(tree.frame_bodies) if body == 0)
    return next((k for k in fixed if tree.frame_names[k] not in (tree.body_names[0], *tree.geom_names)), None)


def _inverse(pose: Pose) -> Pose:
    return Pose(-pose.rotation.T @ pose.position, pose.rotation.T)


def _kind(robot: RobotModel, joint: int) -> str:
    """Return URDF's type of a hinge or slide."""
    if robot.tree.joint_types[joint] == SLIDE:
        return "prismatic"
    return "revolute" if np.isfinite(_limits(robot, joint)[:2]).any() else "continuous"


def _limits(robot: RobotModel, joint: int) -> tuple[float, float, float, float]:
    """Return lower and upper limit, greatest speed and acceleration; a follower's are its leader's to keep."""
    if joint not in robot.tree.dof_address:
        return -math.inf, math.inf, math.inf, math.inf
    name, dof = robot.tree.joint_names[joint], robot.tree.dofs(joint)
    fields = "position_lower", "position_upper", "velocity_limit", "acceleration_limit"
    low, high, speed, acceleration = (one_for_all(getattr(robot, field)[dof], name, field) for field in fields)
    if min(speed, acceleration) == 0.0:
        raise OsikValueError(f"a rate of joint {name!r} is limited to 0, which URDF reads as unknown: lock the joint")
    return low, high, speed, acceleration


def _add_moving(robot: RobotModel, joint: int, element: ElementTree.Element, axis: np.ndarray) -> None:
    """Write axis, limits and leader of a hinge or slide; URDF's speed 0 stands for an unknown one."""
    tree, (low, high, speed, acceleration) = robot.tree, _limits(robot, joint)
    put(element, "axis", xyz=axis)
    limit = put(element, "limit", effort=0.0, velocity=speed if math.isfinite(speed) else 0.0)
    if math.isfinite(acceleration):
        limit.set("acceleration", repr(acceleration))
    if element.get("type") != "continuous":
        limit.set("lower", repr(max(low, -_UNLIMITED)))
        limit.set("upper", repr(min(high, _UNLIMITED)))
    for follower, leader, multiplier in tree.followers:
        if follower == joint:
            offset = float(robot.qpos_offset[tree.full_qpos_address[joint]])
            put(element, "mimic", joint=tree.joint_names[leader], multiplier=multiplier, offset=offset)


def _add_joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, pose: Pose
) -> ElementTree.Element:
    element = put(root, "joint", name=name, type=kind)
    _add_origin(element, pose)
    put(element, "parent", link=parent)
    put(element, "child", link=child)
    return element


def _add_origin(element: ElementTree.Element, pose: Pose) -> None:
    put(element, "origin", xyz=pose.position, rpy=roll_pitch_yaw(pose.rotation))


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return URDF's angles [rad], ``R = Rz(yaw) Ry(pitch) Rx(roll)``; accurate at a pitch of 90 degrees too."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    # the second column without the roll: near 90 degrees the yaw makes up for any roll
    side = rotation[:, 1] * math.cos(roll) - rotation[:, 2] * math.sin(roll)
    return roll, pitch, math.atan2(-side[0], side[1])


def _add_inertial(robot: RobotModel, body: int, link: ElementTree.Element) -> None:
    """Write mass, centre of mass and inertia in the body's axes, unless the body has none."""
    mass, inertia = float(robot.body_mass[body]), np.asarray(robot.body_inertia[body], float)
    if mass <= LEAST_INERTIA:
        return
    element = put(link, "inertial")
    _add_origin(element, Pose(np.asarray(robot.body_com[body], float), np.eye(3)))
    put(element, "mass", value=mass)
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i in range(3) for j in range(i, 3)}
    put(element, "inertia", **entries)


def _add_geom(robot: RobotModel, geom: int, link: ElementTree.Element) -> dict[str, Pose]:
    """Write a box, sphere, cylinder or capsule (a cylinder with two spheres); return the place of its frame, if any."""
    size, kind = np.asarray(robot.geom_size[geom], float), robot.tree.geom_types[geom]
    name, pose = robot.tree.geom_names[geom], pose_of(robot.geom_position[geom], robot.geom_rotation[geom])
    named = bool(name) and name in robot.tree.frame_names and kind in (*_AROUND, *_ALONG)
    if kind in _AROUND:
        form = dict(size=2.0 * size) if _AROUND[kind] == "box" else dict(radius=size[0])
        _add_shape(robot, geom, link, name if named else "", pose, _AROUND[kind], form)
    elif kind in _ALONG:
        form = dict(radius=size[0], length=2.0 * size[1])
        _add_shape(robot, geom, link, name if named else "", pose, "cylinder", form)
        for end in (-size[1], size[1]) if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else ():
            place = pose @ Pose(np.array([0.0, 0.0, end]), np.eye(3))
            _add_shape(robot, geom, link, "", place, "sphere", dict(radius=size[0]))
    return {name: pose} if named else {}


def _add_shape(
    robot: RobotModel, geom: int, link: ElementTree.Element, name: str, pose: Pose, kind: str, form: dict
) -> None:
    """Write one shape: visual if it collides with nothing and has no name to keep, which visual shapes lose."""
    collides = robot.mj_model.geom_contype[geom] or robot.mj_model.geom_conaffinity[geom]
    element = put(link, "collision" if collides or name else "visual", **(dict(name=name) if name else {}))
    _add_origin(element, pose)
    put(put(element, "geometry"), kind, **form)
