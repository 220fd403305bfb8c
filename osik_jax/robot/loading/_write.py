"""Writer of MJCF text from a robot's leaves."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
import scipy  # loads its parts when they are used
from numpy.typing import ArrayLike

from ..._errors import OsikValueError
from .._describe import model_name
from .._model import RobotModel
from .._tree import BALL, FREE, HINGE, QPOS_WIDTH, SLIDE, KinematicTree
from ._equalities import KINDS, Ends, constraint_ends, is_in_tree
from ._followers import free_name
from ._mjmodel import (
    ACCELERATION_LIMIT_PREFIX,
    EQUALITY_END_PREFIX,
    LEAST_INERTIA,
    VELOCITY_LIMIT_PREFIX,
    element_names,
)
from ._poses import IDENTITY, Pose, quaternion, rotation_matrix
from ._robots import ROBOT_ROOTS

_TYPES = {FREE: "free", BALL: "ball", SLIDE: "slide", HINGE: "hinge"}
_SHAPES = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")): name
    for name in ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")
}
_ROUNDOFF = 1e-9
"""Fraction of a body's greatest moment of inertia by which it may break the triangle inequality through rounding."""

_SAME = 1e-6
"""Up to this, a frame and what it is the frame of are in one place [m, or entries of a rotation matrix]."""


class JointPlace(NamedTuple):
    """A joint, with its anchor and axis in its body."""

    joint: int
    anchor: np.ndarray
    axis: np.ndarray


def to_mjcf(robot: RobotModel) -> str:
    """Return the robot as MJCF; see ``Robot.to_mjcf``."""
    refuse_stack(robot)
    root = ElementTree.Element("mujoco", model=model_name(robot) or "robot")
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true", balanceinertia="true")
    bodies = [ElementTree.SubElement(root, "worldbody")]
    for body in range(1, len(robot.tree.body_names)):
        bodies.append(_body(robot, body, bodies[robot.tree.body_parents[body]]))
    _add_frames(robot, bodies)
    custom = ElementTree.SubElement(root, "custom")
    _add_rates(robot, custom)
    _add_roots(robot.tree, custom)
    equality = ElementTree.SubElement(root, "equality")
    _add_followers(robot, equality)
    _add_constraints(robot, bodies, equality)
    _add_home(robot, ElementTree.SubElement(root, "keyframe"))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def refuse_stack(robot: RobotModel) -> None:
    """Raise ValueError for a stack of robots."""
    if np.ndim(robot.body_position) != 2:
        raise OsikValueError(
            f"a stack of robots, body_position {np.shape(robot.body_position)}: write them one by one, "
            "jax.tree.map(lambda leaf: leaf[0], robots)"
        )


def _text(values: ArrayLike) -> str:
    """Return numbers that read back as they are."""
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, float)))


def put(parent: ElementTree.Element, tag: str, **values: str | ArrayLike) -> ElementTree.Element:
    """Add an element; its attributes are texts or numbers."""
    texts = {key: value if isinstance(value, str) else _text(value) for key, value in values.items()}
    return ElementTree.SubElement(parent, tag, texts)


# --- bodies and joints ---


def _body(robot: RobotModel, body: int, parent: ElementTree.Element) -> ElementTree.Element:
    pose, joints = placed_joints(robot, body)
    element = put(parent, "body", name=robot.tree.body_names[body], pos=pose.position, quat=quaternion(pose.rotation))
    _add_inertial(robot, body, element, moving=bool(joints))
    for place in joints:
        _add_joint(robot, place, element)
    return element


def placed_joints(robot: RobotModel, body: int) -> tuple[Pose, list[JointPlace]]:
    """Return the body's pose in its parent, locked joints at their values, and the joints that remain.

    A locked joint moves the body's frame, so the anchors and axes of the joints before it are told from there.
    """
    tree = robot.tree
    position, axes = (np.asarray(leaf[body], float) for leaf in (robot.body_position, robot.body_quaternion))
    pose, joints = Pose(position, rotation_matrix(axes)), []
    for joint in (j for j, owner in enumerate(tree.joint_bodies) if owner == body):
        leaves = robot.joint_position, robot.joint_axis
        place = JointPlace(joint, *(np.asarray(leaf[joint], float) for leaf in leaves))
        if joint not in tree.locked:
            joints.append(place)
        elif tree.joint_types[joint] == FREE:
            values = _values(robot, joint)
            pose = Pose(values[:3], rotation_matrix(values[3:]))
        else:
            motion = _motion(robot, place)
            pose = pose @ motion
            joints = [_seen_from(motion, other) for other in joints]
    return pose, joints


def _values(robot: RobotModel, joint: int) -> np.ndarray:
    """Return the values at which a locked joint is locked."""
    start = robot.tree.full_qpos_address[joint]
    return np.asarray(robot.qpos_offset, float)[start : start + QPOS_WIDTH[robot.tree.joint_types[joint]]]


def _reference(robot: RobotModel, joint: int) -> float:
    return float(robot.joint_reference[robot.tree.full_qpos_address[joint]])


def _motion(robot: RobotModel, place: JointPlace) -> Pose:
    """Return the fixed transform of a locked joint, in its body's frame."""
    values = _values(robot, place.joint)
    is_ball = robot.tree.joint_types[place.joint] == BALL
    moved = Pose(np.zeros(3), rotation_matrix(values)) if is_ball else motion_to(robot, place, float(values[0]))
    return Pose(place.anchor + moved.position - moved.rotation @ place.anchor, moved.rotation)


def motion_to(robot: RobotModel, place: JointPlace, value: float) -> Pose:
    """Return the motion of a hinge or slide about its anchor, from its reference to a value [rad or m]."""
    way = (value - _reference(robot, place.joint)) * place.axis
    if robot.tree.joint_types[place.joint] == SLIDE:
        return Pose(way, np.eye(3))
    return Pose(np.zeros(3), scipy.spatial.transform.Rotation.from_rotvec(way).as_matrix())


def _seen_from(motion: Pose, place: JointPlace) -> JointPlace:
    """Return a joint of the same body, in the frame moved by a locked joint after it.

    That does not change its coordinate: MuJoCo lets nothing that turns come after a ball joint.
    """
    back = motion.rotation.T
    return JointPlace(place.joint, back @ (place.anchor - motion.position), back @ place.axis)


def _add_inertial(robot: RobotModel, body: int, element: ElementTree.Element, *, moving: bool) -> None:
    """Write mass and principal moments, raised to the least that MuJoCo accepts for moving bodies."""
    mass, least = float(robot.body_mass[body]), LEAST_INERTIA if moving else 0.0
    if max(mass, least) == 0.0:
        return
    moments, axes = np.linalg.eigh(np.asarray(robot.body_inertia[body], float))
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    excess = moments[2] - moments[0] - moments[1]
    if 0.0 < excess <= _ROUNDOFF * moments[2]:
        moments[0] += 2.0 * excess
    put(
        element,
        "inertial",
        mass=max(mass, least),
        pos=robot.body_com[body],
        quat=quaternion(axes),
        diaginertia=np.maximum(moments, least),
    )


def _add_joint(robot: RobotModel, place: JointPlace, element: ElementTree.Element) -> None:
    tree, joint = robot.tree, place.joint
    kind, name = tree.joint_types[joint], tree.joint_names[joint]
    values: dict[str, str | ArrayLike] = {}
    if kind in (HINGE, SLIDE):
        values |= dict(axis=place.axis, ref=_reference(robot, joint))
    if kind != FREE:
        values |= dict(pos=place.anchor)
    start, end = tree.full_dof_address[joint : joint + 2]
    armature = one_for_all(robot.dof_armature[start:end], name, "armature")
    if armature:
        values |= dict(armature=armature)
    put(element, "joint", name=name, type=_TYPES[kind], **values, **_range(robot, joint))


def _range(robot: RobotModel, joint: int) -> dict[str, ArrayLike]:
    """Return the limits of an independent joint; a follower has those of its leader, which the leader keeps."""
    tree, name = robot.tree, robot.tree.joint_names[joint]
    if joint not in tree.dof_address:
        return {}
    lower, upper = (np.asarray(leaf[tree.dofs(joint)], float) for leaf in (robot.position_lower, robot.position_upper))
    if np.isinf(lower).all() and np.isinf(upper).all():
        return {}
    if tree.joint_types[joint] == FREE:
        raise OsikValueError(f"joint {name!r} is free: MJCF has no place for its position limits")
    if tree.joint_types[joint] == BALL:
        return dict(range=(0.0, one_for_all(upper, name, "upper")))
    low, high = float(lower[0]), float(upper[0])
    if math.isinf(low) or math.isinf(high):
        raise OsikValueError(f"joint {name!r} is limited on one side, [{low}, {high}]: MJCF has both limits or none")
    # MuJoCo asks for lower < upper: equal limits are one unit in the last place apart.
    return dict(range=(low, max(high, math.nextafter(low, math.inf))))


def one_for_all(values: ArrayLike, joint: str, what: str) -> float:
    """Return the one value that all dofs of a joint share."""
    first, *others = np.asarray(values, float)
    if any(other != first for other in others):
        raise OsikValueError(f"the dofs of joint {joint!r} differ in {what}: the file has one value a joint")
    return float(first)


# --- frames and shapes ---


def _add_frames(robot: RobotModel, bodies: list[ElementTree.Element]) -> None:
    """Write geoms of simple shapes, and as sites all frames that are neither those nor bodies."""
    for name, body, pose in other_frames(robot, _add_geoms(robot, bodies)):
        put(bodies[body], "site", name=name, pos=pose.position, quat=quaternion(pose.rotation))


def other_frames(robot: RobotModel, geoms: dict[str, Pose]) -> Iterator[tuple[str, int, Pose]]:
    """Yield name, body and pose of the frames that are neither bodies nor geoms.

    A frame of a body or of one of ``geoms`` that is not where that is raises ValueError.
    """
    tree, places = robot.tree, dict.fromkeys(robot.tree.body_names, IDENTITY) | geoms
    for k, (name, body) in enumerate(zip(tree.frame_names, tree.frame_bodies, strict=True)):
        pose = frame_pose(robot, k)
        if name not in places:
            yield name, body, pose
        elif not all(np.allclose(a, b, rtol=0.0, atol=_SAME) for a, b in zip(pose, places[name], strict=True)):
            raise OsikValueError(
                f"frame {name!r} is a body or geom of its own and not where that is: move both, or neither"
            )


def pose_of(position: ArrayLike, rotation: ArrayLike) -> Pose:
    """Return a pose of NumPy's arrays in double precision."""
    return Pose(np.asarray(position, float), np.asarray(rotation, float))


def frame_pose(robot: RobotModel, frame: int) -> Pose:
    """Return the pose of a frame in its body."""
    return pose_of(robot.frame_position[frame], robot.frame_rotation[frame])


def _add_geoms(robot: RobotModel, bodies: list[ElementTree.Element]) -> dict[str, Pose]:
    """Return the shapes that need no file; the frames that are their names, and where they are."""
    model, tree = robot.mj_model, robot.tree
    done: dict[str, Pose] = {}
    for g in (g for g, kind in enumerate(tree.geom_types) if kind in _SHAPES):
        pose = pose_of(robot.geom_position[g], robot.geom_rotation[g])
        values, name = _appearance(model, g), mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g)
        if name:
            name = f"geom:{name}" if f"geom:{name}" in tree.frame_names else name
            done[name] = pose
            values |= dict(name=name)
        places = dict(size=robot.geom_size[g], pos=pose.position, quat=quaternion(pose.rotation))
        put(bodies[tree.geom_bodies[g]], "geom", **values, **places)
    return done


def _appearance(model: mujoco.MjModel, geom: int) -> dict[str, str | ArrayLike]:
    """Return the attributes of a geom for kind, colour and collisions; masses belong to the bodies."""
    material = model.geom_matid[geom]
    return dict(
        type=_SHAPES[int(model.geom_type[geom])],
        rgba=model.geom_rgba[geom] if material < 0 else model.mat_rgba[material],
        group=str(model.geom_group[geom]),
        contype=str(model.geom_contype[geom]),
        conaffinity=str(model.geom_conaffinity[geom]),
        mass="0",
    )


# --- what is said of the whole ---


def _add_rates(robot: RobotModel, element: ElementTree.Element) -> None:
    rates = {
        VELOCITY_LIMIT_PREFIX: (robot.velocity_limit, "greatest speed"),
        ACCELERATION_LIMIT_PREFIX: (robot.acceleration_limit, "greatest acceleration"),
    }
    for joint in robot.tree.independent:
        name = robot.tree.joint_names[joint]
        for prefix, (values, what) in rates.items():
            rate = one_for_all(values[robot.tree.dofs(joint)], name, what)
            if math.isfinite(rate):
                put(element, "numeric", name=prefix + name, data=rate)


def _add_roots(tree: KinematicTree, element: ElementTree.Element) -> None:
    """Write which trees are the robot, where there are several and that is clear."""
    trees = sum(not parent for parent in tree.body_parents[1:])
    if trees > 1 and len(tree.robots) <= 1:
        ElementTree.SubElement(element, "text", name=ROBOT_ROOTS, data=" ".join(tree.body_names[b] for b in tree.tops))


def _add_followers(robot: RobotModel, element: ElementTree.Element) -> None:
    """Write ``q_follower - reference = constant + multiplier (q_leader - reference)``, as MuJoCo has it."""
    tree = robot.tree
    for follower, leader, multiplier in tree.followers:
        offset = float(robot.qpos_offset[tree.full_qpos_address[follower]])
        constant = offset - _reference(robot, follower) + multiplier * _reference(robot, leader)
        names = dict(joint1=tree.joint_names[follower], joint2=tree.joint_names[leader])
        put(element, "joint", **names, polycoef=(constant, multiplier, 0.0, 0.0, 0.0))


def _add_constraints(robot: RobotModel, bodies: list[ElementTree.Element], element: ElementTree.Element) -> None:
    """Constraints that are not in the tree: closed loops, and joints coupled by polynomials."""
    model, tree = robot.mj_model, robot.tree
    names = element_names(model, "equality")
    for e in (e for e in range(model.neq) if int(model.eq_type[e]) in KINDS and not is_in_tree(model, e)):
        kind = KINDS[int(model.eq_type[e])]
        places: dict[str, str | ArrayLike] = {}
        if kind == "joint":
            joints = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e]) if i >= 0]
            if set(tree.locked) & set(joints):
                continue  # with a constant in the place of one joint, the file would lock the other
            places |= {f"joint{k + 1}": tree.joint_names[joint] for k, joint in enumerate(joints)}
            places["polycoef"] = model.eq_data[e, :5]
        else:
            ends = constraint_ends(model, tree.frame_names, e)
            places |= dict(zip(("site1", "site2"), _end_sites(robot, bodies, ends, names[e]), strict=True))
        if kind == "weld":
            places["torquescale"] = model.eq_data[e, 10]
        put(element, kind, name=names[e], active=str(bool(model.eq_active0[e])).lower(), **places)


def _end_sites(robot: RobotModel, bodies: list[ElementTree.Element], ends: Ends, name: str) -> list[str]:
    """Add sites at the ends of a constraint; return their names."""
    numbers = [robot.tree.frame(frame) for frame in ends.frames]
    first, second = (frame_pose(robot, k) for k in numbers)
    turns = first.rotation @ ends.relative @ second.rotation.T, np.eye(3)  # of a weld the two are to agree
    made = []
    for k, pose, anchor, turn in zip(numbers, (first, second), ends.anchors, turns, strict=True):
        made.append(free_name(f"{EQUALITY_END_PREFIX}{name}/{len(made) + 1}", robot.tree.frame_names))
        position = pose.position + pose.rotation @ anchor
        put(bodies[robot.tree.frame_bodies[k]], "site", name=made[-1], pos=position, quat=quaternion(turn))
    return made


def _add_home(robot: RobotModel, element: ElementTree.Element) -> None:
    tree, full = robot.tree, np.asarray(robot.mujoco_qpos(robot.q0), float)
    kept = [full[start:end] for start, end in zip(tree.full_qpos_address, tree.full_qpos_address[1:], strict=False)]
    moving = [values for joint, values in enumerate(kept) if joint not in tree.locked]
    put(element, "key", name="home", qpos=np.concatenate(moving))
