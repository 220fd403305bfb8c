"""Legs and arms found in a robot's kinematic tree: which joint is a knee or an elbow, and the position of a wrist."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError
from ..kinematics import Kinematics
from ..robot import Robot
from ..robot._mujoco import home_poses
from ..robot._tree import BALL, HINGE
from ._link_shapes import SHAPES, geom_points
from ._profile import Place, Point, as_place

ORIGIN: Point = (0.0, 0.0, 0.0)
# Joints closer than this [m] are at one place, as the three hinges of a hip.
_SAME = 1e-6
_BENDS = 0.5
"""A hinge bends a limb if the sine of the angle between its axis and the limb is above this; else it twists the limb
(0.19 for a G1's shoulder yaw).
"""
_SHORTEST = 0.2
"""Least distance of a knee or elbow from either end of its limb, as a share of the sum of both distances."""
_LEAST_FOREARM = 0.2
"""Least distance of a hand frame from the joint before it, as a share of the upper arm."""
_MOST_FOREARM = 1.2
"""Largest forearm, as a share of the upper arm, where only masses tell its length; files contain placeholder inertias.
"""
_GRIPS = re.compile(r"grip|finger|thumb|hand$", re.IGNORECASE)
_HANDS = ("wrist", "hand", "palm", "grip", "tool|tcp|effector", "tip")
"""Names of frames at the end of an arm, those nearest to the wrist first."""


class Chain(NamedTuple):
    """Bodies from the trunk to the end of a limb (k,), and the position of each body's joint at home [m] (k, 3)."""

    bodies: tuple[int, ...]
    anchors: Float[np.ndarray, "k 3"]


class Limb(NamedTuple):
    """The joints of a limb: hip, knee and ankle, or shoulder, elbow and wrist; None: the limb ends before."""

    first: Place
    bend: Place
    end: Place | None


def base_body(robot: Robot) -> int:
    """Return the body that all limbs hang from: the root of a free base, else the world."""
    return robot.tree.root if robot.floating_base else 0


def find_chains(robot: Robot, kinematics: Kinematics, ends: list[int], least: int = 3) -> list[Chain]:
    """Return the limbs that end in some bodies, those with ``least`` joints."""
    chains = []
    for end in ends:
        others = [other for other in ends if other != end]
        above = robot.tree.descendants[:, end] & ~robot.tree.descendants[:, np.array(others, int)].any(1)
        bodies = tuple(int(b) for b in np.flatnonzero(above) if b not in (0, base_body(robot)))
        if len(bodies) < least:
            raise OsikValueError(
                f"the limb that ends in {robot.tree.body_names[end]} has {len(bodies)} joints; it needs {least}"
            )
        chains.append(Chain(bodies, np.asarray(kinematics.body_position)[list(bodies)]))
    return chains


def find_leg(robot: Robot, kinematics: Kinematics, leg: Chain, foot: str, *, pointed: bool = False) -> Limb:
    """Return hip, knee and ankle of a leg; the foot is the ankle if it is ``pointed`` or no joint moves it."""
    knee = _bend(robot, kinematics, leg, 0)
    ankle = None if knee is None else _after(leg.anchors, knee)
    if knee is not None and ankle is not None and not pointed:
        return Limb(*(_body(robot, leg.bodies[i]) for i in (max(knee - 2, 0), knee, ankle)))
    at = np.asarray(kinematics.frame_pose(robot, foot)[0])
    extended = Chain((*leg.bodies, leg.bodies[-1]), np.concatenate([leg.anchors, at[None]]))
    knee = _bend(robot, kinematics, extended, 0)
    if knee is None or not knee:
        raise _stiff(robot, leg)
    return Limb(_body(robot, leg.bodies[knee - 1]), _body(robot, leg.bodies[knee]), (foot, ORIGIN))


def find_arm(robot: Robot, kinematics: Kinematics, arm: Chain) -> Limb:
    """Return shoulder, elbow and wrist of an arm.

    The elbow is the joint that bends the arm far from the shoulder and from the last joint of the hand, and the wrist
    is that last joint. Where no joint between them bends the arm, the arm has no wrist joint: the end of its last link
    is the wrist. Where none bends it so either, the arm ends at the elbow: at its last joint, or at the end of its last
    link if that is far from there.
    """
    hand = _hand(robot, arm)
    own = Chain(arm.bodies[: hand + 1], arm.anchors[: hand + 1])
    elbow = _bend(robot, kinematics, own, 1)
    if elbow is not None:
        return _limb(robot, own, elbow, _body(robot, own.bodies[hand]))
    fingers = [i for i in range(hand + 1, len(arm.bodies)) if _apart(arm.anchors[i], arm.anchors[hand])]
    if fingers:
        wrist, end = _body(robot, arm.bodies[fingers[0]]), arm.anchors[fingers[0]]
    else:
        wrist, end = find_end(robot, kinematics, arm, hand)
    extended = Chain((*own.bodies, own.bodies[-1]), np.concatenate([own.anchors, end[None]]))
    elbow = _bend(robot, kinematics, extended, 1)
    if elbow is not None:
        return _limb(robot, own, elbow, wrist)
    lengths = np.linalg.norm(extended.anchors[-2:] - own.anchors[min(1, hand)], axis=-1)
    if not lengths.max() > _SAME:
        raise _stiff(robot, arm)
    last = _body(robot, own.bodies[-1]) if lengths[0] > (1.0 - _SHORTEST) * lengths[1] else wrist
    return Limb(_body(robot, own.bodies[min(1, hand)]), last, None)


def _limb(robot: Robot, own: Chain, elbow: int, wrist: Place) -> Limb:
    return Limb(_body(robot, own.bodies[min(1, elbow - 1)]), _body(robot, own.bodies[elbow]), wrist)


def _body(robot: Robot, body: int) -> Place:
    return robot.tree.body_names[body], ORIGIN


def _stiff(robot: Robot, limb: Chain) -> ValueError:
    return OsikValueError(
        f"the limb that ends in {robot.tree.body_names[limb.bodies[-1]]} has no joint between its ends that bends it "
        "as a person's does; give a profile that says where its keypoints are"
    )


def _apart(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.linalg.norm(a - b) > _SAME)


def _bend(robot: Robot, kinematics: Kinematics, limb: Chain, first: int) -> int | None:
    """Return the index of the knee or elbow (the bending joint farthest from both ends of a limb), or None.

    ``first`` is the index of the joint at which the limb begins.
    """
    first = min(first, len(limb.anchors) - 1)
    beginning, end = limb.anchors[first], limb.anchors[-1]
    ends = np.linalg.norm(limb.anchors[:, None] - np.stack([beginning, end]), axis=-1)
    near = ends.min(1)
    inside = near > np.maximum(_SHORTEST * ends.sum(1), _SAME)
    places = [i for i in range(1, len(near) - 1) if inside[i] and _bends(robot, kinematics, limb, i)]
    if not places:
        return None
    best = max(near[i] for i in places)
    # the first of joints at one place, which differ by rounding
    bend = next(i for i in places if near[i] > 0.999 * best)
    return next(i for i in range(1, bend + 1) if not _apart(limb.anchors[i], limb.anchors[bend]))


def _bends(robot: Robot, kinematics: Kinematics, limb: Chain, i: int) -> bool:
    """Return whether a joint moves the part behind it sideways rather than twisting it."""
    tree, behind = robot.tree, _after(limb.anchors, i)
    if behind is None:
        return False
    along = limb.anchors[behind] - limb.anchors[i]
    turn, axes = np.asarray(kinematics.body_rotation[limb.bodies[i]]), np.asarray(robot.joint_axis)
    own = [j for j, body in enumerate(tree.joint_bodies) if body == limb.bodies[i] and j not in tree.locked]
    across = np.linalg.norm(np.cross(axes[own] @ turn.T, along), axis=-1) / np.linalg.norm(along)
    kinds = [tree.joint_types[joint] for joint in own]
    return BALL in kinds or any(kind == HINGE and sine > _BENDS for kind, sine in zip(kinds, across, strict=True))


def _after(anchors: np.ndarray, joint: int) -> int | None:
    """Return the index of the next joint at another position, or None."""
    return next((i for i in range(joint + 1, len(anchors)) if _apart(anchors[i], anchors[joint])), None)


def _hand(robot: Robot, arm: Chain) -> int:
    """Return the index of the last body that moves the whole hand; fingers or a gripper branch off behind it.

    A gripper's joint is coupled to another joint, or its name says so.
    """
    tree = robot.tree
    coupled = {joint for follower, leader, _ in tree.followers for joint in (follower, leader)}
    for i in range(2, len(arm.bodies)):
        siblings = sum(parent == tree.body_parents[arm.bodies[i]] for parent in tree.body_parents)
        joints = [j for j, body in enumerate(tree.joint_bodies) if body == arm.bodies[i]]
        if siblings > 1 or any(j in coupled or _GRIPS.search(tree.joint_names[j]) for j in joints):
            return i - 1
    return len(arm.bodies) - 1


def find_end(
    robot: Robot,
    kinematics: Kinematics,
    arm: Chain,
    last: int,
    *,
    patterns: Sequence[str] = _HANDS,
    least_share: float = _LEAST_FOREARM,
) -> tuple[Place, np.ndarray]:
    """Return the end of the last link of an arm or finger as a place and in the world [m].

    It is a named frame (``patterns``, the preferred ones first), else the far end of the link. Such a frame is at least
    ``least_share`` of the upper arm from the last joint.
    """
    tree, body, anchor = robot.tree, arm.bodies[last], arm.anchors[last]
    upper = float(np.linalg.norm(anchor - arm.anchors[min(1, last)]))
    names = [name for name, own in zip(tree.frame_names, tree.frame_bodies, strict=True) if own == body]
    for pattern in patterns:
        named = [name for name in names if re.search(pattern, name, re.IGNORECASE)]
        at = {name: np.asarray(kinematics.frame_pose(robot, name)[0]) for name in named}
        far = {name: float(np.linalg.norm(place - anchor)) for name, place in at.items()}
        far = {name: length for name, length in far.items() if length > max(least_share * upper, _SAME)}
        if far:
            nearest = min(far, key=lambda name: (far[name], name))
            return (nearest, ORIGIN), at[nearest]
    most = _MOST_FOREARM * upper if upper > 0.0 else np.inf  # no upper arm to compare with
    end = _far_end(robot, body, anchor, most)
    return as_place(robot, kinematics, tree.body_names[body], end), end


def _far_end(robot: Robot, body: int, anchor: np.ndarray, most: float) -> np.ndarray:
    """Return the end of a body along the line from its joint to its middle [m].

    It is that of its meshes; without them, that of its other shapes or masses, whichever is farther. Bodies fixed to it
    count. ``anchor`` is its joint in the world; without meshes a length of ``most`` [m] is accepted.
    """
    model = robot.mj_model
    data = home_poses(robot)
    own = model.body(robot.tree.body_names[body]).id
    fixed = [b for b in range(model.nbody) if model.body_weldid[b] == model.body_weldid[own]]
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, fixed) & np.isin(model.geom_type, SHAPES))
    meshes = geoms[model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_MESH]
    if len(meshes):
        points = _points(model, data, meshes)
        return _farthest(points, points.mean(0), anchor, np.inf)
    masses = model.body_mass[fixed]
    middle = masses @ data.xipos[fixed] / max(float(masses.sum()), 1e-12)
    points = np.concatenate([_points(model, data, geoms), *(_rod(model, data, b) for b in fixed)])
    return _farthest(points, middle, anchor, most)


def _farthest(points: np.ndarray, middle: np.ndarray, anchor: np.ndarray, most: float) -> np.ndarray:
    """Return the projection of the farthest of ``points`` on the line from ``anchor`` through ``middle`` [m]."""
    along = (middle - anchor) / max(float(np.linalg.norm(middle - anchor)), _SAME)
    return anchor + np.clip(((points - anchor) @ along).max(), 0.0, most) * along


def _points(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray) -> Float[np.ndarray, "k 3"]:
    """Return the vertices of mesh geoms, and the corners of boxes around others, in the world [m]."""
    out = [np.zeros((0, 3))]
    for geom in geoms:
        body = model.geom_bodyid[geom]
        out.append(data.xpos[body] + geom_points(model, int(geom)) @ data.xmat[body].reshape(3, 3).T)
    return np.concatenate(out)


def _rod(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Float[np.ndarray, "2 3"]:
    """Return both ends of the rod with the mass and inertia of a body, in the world [m].

    A rod of half length h has the second moment ``m h^2 / 3`` along itself.
    """
    inertia = model.body_inertia[body]
    moments = np.maximum(0.5 * inertia.sum() - inertia, 0.0)
    longest = int(np.argmax(moments))
    half = np.sqrt(3.0 * moments[longest] / max(float(model.body_mass[body]), 1e-12))
    along = half * data.ximat[body].reshape(3, 3)[:, longest]
    return data.xipos[body] + np.stack([along, -along])
