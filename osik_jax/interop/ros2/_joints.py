"""Conversion of messages to numbers (joint states by name, poses, stamps), with the reasons to refuse them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..._errors import OsikValueError, unknown_name
from ...numerics._rotations import ROUNDED
from ...robot import Robot
from ...robot._joint_selection import is_scalar
from ...robot._tree import FREE
from ._settings import Settings


class Refused(Exception):
    """Reason why a message is not used."""


@dataclasses.dataclass(frozen=True)
class JointNames:
    """Joints of a robot under their ROS names."""

    names: tuple[str, ...]  # ROS names of the independent joints, in the order of v. (n,)
    index: np.ndarray  # entry of q of each joint. (n,)
    dofs: np.ndarray  # entry of v of each joint. (n,)
    ignored: frozenset[str]  # ROS names that are known and not used: joints that follow others, and locked ones

    def read(self, message: Any) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """Return indices in ``names``, positions [rad or m], and the names that no joint has."""
        if len(message.name) != len(message.position):
            raise Refused(f"a joint state has {len(message.name)} names and {len(message.position)} positions")
        if len(set(message.name)) != len(message.name):
            raise Refused("a joint state names a joint twice")
        place = {name: number for number, name in enumerate(self.names)}
        known = [(place[name], at) for at, name in enumerate(message.name) if name in place]
        positions = np.asarray(message.position, float)
        values = positions[[at for _, at in known]]
        if not np.isfinite(values).all():
            raise Refused("a joint state has positions that are not finite")
        unknown = tuple(name for name in message.name if name not in place and name not in self.ignored)
        return np.array([joint for joint, _ in known], int), values, unknown


def joint_names(robot: Robot, settings: Settings) -> JointNames:
    """Return the joints of a robot, renamed as the settings say."""
    tree, ros = robot.tree, {model: name for name, model in settings.names.items()}
    for name in ros:
        if name not in tree.joint_names:
            raise unknown_name("joint", name, tree.joint_names)
    used = [joint for joint in tree.independent if tree.joint_types[joint] != FREE]
    other = [tree.joint_names[joint] for joint in used if not is_scalar(robot, joint)]
    if other:
        raise OsikValueError(f"joints that turn about three axes have no place in a JointState: {', '.join(other)}")
    names = tuple(ros.get(name, name) for name in robot.joint_names)
    unused = {ros.get(name, name) for name in (*robot.mimic_joints, *robot.locked_joints)}
    index, dofs = (np.array([address[j] for j in used], int) for address in (tree.qpos_address, tree.dof_address))
    return JointNames(names, index, dofs, frozenset(unused))


def stamp_of(message: Any, received_ns: int, settings: Settings) -> int:
    """Return the stamp of a message [ns], or its time of reception if stamps are not checked."""
    if not settings.check_stamps:
        return received_ns
    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    if stamp == 0:
        raise Refused("a message has no stamp; check_stamps = false takes it")
    age = (received_ns - stamp) * 1e-9
    if abs(age) > settings.max_age:
        side = "old" if age > 0.0 else "ahead of this machine's clock"
        raise Refused(f"a message is more than max_age = {settings.max_age:g} s {side}")
    return stamp


def pose_of(message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) [m] and rotation matrix (3, 3) of a PoseStamped."""
    p, o = message.pose.position, message.pose.orientation
    position, quaternion = np.array([p.x, p.y, p.z], float), np.array([o.x, o.y, o.z, o.w], float)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise Refused("a pose is not finite")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > ROUNDED:
        raise Refused(f"a pose's quaternion has length {length:.3g}; it is 1")
    return position, Rotation.from_quat(quaternion).as_matrix()
