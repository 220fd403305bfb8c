"""Joint transforms relative to the parent bodies, so that XLA does not recompute chains of parents.

Functions take arrays of JAX or, on the host, of NumPy: nothing is compiled for a robot's home configuration.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..numerics._host import Numbers, module_of
from ..robot import Robot
from ..robot._tree import BALL, FREE, HINGE, SLIDE, KinematicTree
from ._rigid import quaternion_product, rotate, rotation_matrix, squared_length, unit_quaternion


class JointTransforms(NamedTuple):
    """Poses and joints of all bodies, each in the frame of the body's parent.

    Attributes:
        position: origin of each body [m]; row 0 is the world, 0. (nbody, 3)
        rotation: from each body's axes to its parent's; row 0 is the identity. (nbody, 3, 3)
        anchor: a point on each joint's axis [m]. (njoint, 3)
        axis: of each joint, as long as its quaternion and axis in the model are; none for free joints. (njoint, 3)
    """

    position: Float[Numbers, "nbody 3"]
    rotation: Float[Numbers, "nbody 3 3"]
    anchor: Float[Numbers, "njoint 3"]
    axis: Float[Numbers, "njoint 3"]


class _Round(NamedTuple):
    """The k-th joint of every body that has as many; bodies with fewer have joint 0 and no kind.

    Attributes:
        joint: index of the joint. (nbody,)
        first: index of its first entry in the full configuration. (nbody,)
        kinds: for MuJoCo's joint types, whether the joint is one, None if none is. (nbody, 1)
    """

    joint: np.ndarray
    first: np.ndarray
    kinds: dict[int, np.ndarray | None]


def joint_transforms(robot: Robot, qpos: Float[Numbers, " nqfull"]) -> JointTransforms:
    """Return poses and joints relative to the parents at a full configuration; its quaternions are normalised."""
    xp, tree = module_of(qpos), robot.tree
    moves = np.arange(len(tree.body_names))[:, None] > 0
    position = xp.where(moves, robot.body_position, 0.0)
    turn = xp.where(moves, robot.body_quaternion, np.eye(1, 4, dtype=qpos.dtype))
    rotation = rotation_matrix(turn)
    anchors, axes = [], []
    rounds, order = _rounds(tree)
    for joints in rounds:
        position, turn, rotation, anchor, axis = _moved(robot, qpos, joints, position, turn, rotation)
        anchors.append(anchor)
        axes.append(axis)
    return JointTransforms(position, rotation, xp.concatenate(anchors)[order], xp.concatenate(axes)[order])


def _moved(
    robot: Robot, qpos: Numbers, joints: _Round, position: Numbers, turn: Numbers, rotation: Numbers
) -> tuple[Numbers, Numbers, Numbers, Numbers, Numbers]:
    """Return position, quaternion and rotation of all bodies after one joint each, and that joint's anchor and axis."""
    xp, (joint, first, kinds) = module_of(qpos), joints
    fixed, given = robot.joint_position[joint], robot.joint_axis[joint]
    anchor = position + squared_length(turn) * rotate(rotation, fixed)
    axis = squared_length(turn) * rotate(rotation, given)
    displacement = (qpos[first] - robot.joint_reference[first])[:, None]
    slides, hinges, balls, free = (kinds[kind] for kind in (SLIDE, HINGE, BALL, FREE))
    if slides is not None:
        position = xp.where(slides, position + displacement * axis, position)
    if hinges is not None:
        half = xp.where(hinges, 0.5 * displacement, 0.0)
        local = xp.concatenate([xp.cos(half), xp.sin(half) * given], -1)
        turn = quaternion_product(turn, local)
    identity = np.eye(1, 4, dtype=qpos.dtype)
    if balls is not None:
        own = unit_quaternion(xp.where(balls, qpos[_entries(first, balls, 4)], identity))
        turn = xp.where(balls, quaternion_product(turn, own), turn)
    if free is not None:
        pose = qpos[_entries(first, free, 7)]
        position, anchor = (xp.where(free, pose[:, :3], other) for other in (position, anchor))
        turn = xp.where(free, unit_quaternion(xp.where(free, pose[:, 3:], identity)), turn)
    rotation = rotation_matrix(turn)
    rotates = _either(hinges, balls)
    if rotates is not None:
        position = xp.where(rotates, anchor - squared_length(turn) * rotate(rotation, fixed), position)
    return position, turn, rotation, anchor, axis


def _entries(first: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of a joint's entries of the full configuration for the own bodies, 0, 1, ... for the rest."""
    return np.where(own, first[:, None], 0) + np.arange(count, dtype=np.int32)


def _either(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
    return b if a is None else a if b is None else a | b


@lru_cache(maxsize=64)
def _rounds(tree: KinematicTree) -> tuple[list[_Round], np.ndarray]:
    """Return each round of joints, and where each joint's row is in the rounds' rows one after another. (njoint,).

    Indices are of JAX's integers in either precision.
    """
    types, owners = np.array(tree.joint_types, int), np.array(tree.joint_bodies, int)
    bodies, count = len(tree.body_names), np.zeros(len(tree.body_names), int)
    number = np.zeros(len(types), int)
    for joint, owner in enumerate(owners):
        number[joint] = count[owner]
        count[owner] += 1
    rounds = []
    for k in range(count.max(initial=0)):
        own = np.flatnonzero(number == k)
        joint, kind = np.zeros(bodies, np.int32), np.full(bodies, -1)
        joint[owners[own]], kind[owners[own]] = own, types[own]
        kinds: dict[int, Any] = {t: (kind == t)[:, None] for t in (FREE, BALL, SLIDE, HINGE)}
        found = {t: mask if mask.any() else None for t, mask in kinds.items()}
        rounds.append(_Round(joint, tree.full_qpos_address[joint].astype(np.int32), found))
    return rounds, (number * bodies + owners).astype(np.int32)


def dof_kinds(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint type of each dof (locked ones included), and the dof's index within its joint."""
    kinds = np.asarray(tree.joint_types, int)[tree.dof_joint]
    return kinds, np.arange(len(kinds)) - tree.full_dof_address[:-1][tree.dof_joint]
