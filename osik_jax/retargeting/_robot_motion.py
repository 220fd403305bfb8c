"""Robot motions in MuJoCo's order, as written and read by retargeting."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from .._errors import OsikValueError
from ..numerics._columns import read_columns
from ..robot import Robot
from ..robot._mujoco import model_qpos
from ..robot._tree import FREE
from ._load import check_has, load_arrays
from ._motion import check_rate, instants
from ._rotations import slerp


@dataclasses.dataclass(frozen=True)
class RobotMotion:
    """Motion of a robot in MuJoCo's joint order.

    Attributes:
        fps: frame rate [1/s].
        joint_names: joints of the columns of ``qpos`` after the seven of the free joint.
        qpos: position of the base [m], its quaternion w x y z, then one number per joint [rad or m]; of a robot whose
            base is fixed the joints alone. (F, 7 + joints) or (F, joints)
        contact: whether left heel, left toe, right heel and right toe stand; None: unknown. (F, 4)

    Raises:
        ValueError: shapes that do not agree, numbers that are not finite, or quaternions that are not of unit length.
    """

    fps: float
    joint_names: tuple[str, ...]
    qpos: Float[np.ndarray, "F nq"]
    contact: Bool[np.ndarray, "F 4"] | None = None

    def __post_init__(self) -> None:
        joints = len(self.joint_names)
        if self.qpos.ndim != 2 or self.qpos.shape[1] not in (joints, 7 + joints) or not len(self.qpos):
            raise OsikValueError(
                f"qpos has shape {self.qpos.shape}, expected (F, {7 + joints}): the free joint's seven numbers and "
                f"{joints} joints; or (F, {joints}), where the base is fixed"
            )
        if not np.isfinite(self.qpos).all():
            raise OsikValueError(f"qpos is not finite in frame {int(np.argwhere(~np.isfinite(self.qpos))[0][0])}")
        off = np.abs(np.linalg.norm(self.qpos[:, 3:7], axis=1) - 1.0)
        # tolerance for the rounding of numbers in files
        if self.is_free and off.max() > 1e-3:
            raise OsikValueError(
                f"the base's quaternion (columns 3 to 6) is not of unit length in frame {off.argmax()}"
            )
        check_rate(self.fps)
        if self.contact is not None and np.shape(self.contact) != (len(self.qpos), 4):
            raise OsikValueError(f"contact has shape {np.shape(self.contact)}, expected {(len(self.qpos), 4)}")

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, joint_names: Sequence[str] | None = None, fps: float | None = None
    ) -> RobotMotion:
        """Read a robot's motion: ``motion.npz``, or a CSV without headings with the quaternion as x y z w.

        Args:
            path: the file, ``.npz`` or ``.csv``.
            joint_names: joints of a CSV's columns; not with a ``.npz``, which contains them.
            fps: frame rate of a CSV [1/s]; not with a ``.npz``, which contains it.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is broken, a CSV comes without ``joint_names`` and ``fps``, or a ``.npz`` with them.
        """
        source = Path(path)
        if source.suffix.lower() != ".csv":
            if joint_names is not None or fps is not None:
                raise OsikValueError(f"{source}: joint_names and fps go with a CSV; a .npz has its own")
            arrays = load_arrays(source)
            check_has(source, arrays, "fps", "qpos", "joint_names")
            names = tuple(str(name) for name in arrays["joint_names"].ravel())
            contact = None if "contact" not in arrays else arrays["contact"].astype(bool)
            return cls(float(arrays["fps"]), names, arrays["qpos"].astype(float), contact)
        if joint_names is None or fps is None:
            raise OsikValueError(f"{source}: a CSV holds numbers alone; say joint_names and fps")
        if not source.is_file():
            raise FileNotFoundError(f"no such file: {source}")
        joints = len(joint_names)
        columns = read_columns(source, [str(k) for k in range(8 + joints)])  # one more, so that its number is told
        if len(columns) not in (joints, 7 + joints):
            raise OsikValueError(f"{source}, line 1: {len(columns)} numbers, not {7 + joints}")
        values = np.stack([*columns.values()], -1)
        base = [] if len(columns) == joints else [0, 1, 2, 6, 3, 4, 5]
        return cls(fps, tuple(joint_names), values[:, [*base, *range(len(base), values.shape[1])]])

    @property
    def is_free(self) -> bool:
        """Return whether ``qpos`` has the seven columns of a free joint, so that the base moves."""
        return self.qpos.shape[1] > len(self.joint_names)

    def resampled(self, fps: float) -> RobotMotion:
        """Return the motion at another rate: linear interpolation of joints, spherical interpolation of the base.

        Raises:
            ValueError: a rate that is not positive.
        """
        if check_rate(fps) == self.fps or len(self.qpos) == 1:
            return dataclasses.replace(self, fps=float(fps))
        before, part = instants(len(self.qpos), self.fps, fps)
        low, high = self.qpos[before], self.qpos[before + 1]
        qpos = low + part[:, None] * (high - low)
        if self.is_free:
            qpos[:, 3:7] = slerp(low[:, 3:7], high[:, 3:7], part)
        contact = None if self.contact is None else self.contact[before + (part >= 0.5)]
        return RobotMotion(float(fps), self.joint_names, qpos, contact)

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the CSV layout of GMR and mjlab: position, quaternion x y z w, joints; no headings."""
        base = [0, 1, 2, 4, 5, 6, 3] if self.is_free else []
        columns = [*base, *range(len(base), self.qpos.shape[1])]
        np.savetxt(path, self.qpos[:, columns], fmt="%.9g", delimiter=",")


def joints_in_mujoco_order(robot: Robot) -> tuple[str, ...]:
    """Return the names of all joints of the robot's model but the free joint, in the order of ``RobotMotion``."""
    tree = robot.tree
    return tuple(name for name, kind in zip(tree.joint_names, tree.joint_types, strict=True) if kind != FREE)


def in_mujoco_order(robot: Robot, q: Float[np.ndarray, "F nq"], fps: float) -> RobotMotion:
    """Return a motion with all joints of the robot's model, locked and coupled joints included."""
    tree, qpos = robot.tree, model_qpos(robot, q)
    joints = [int(tree.full_qpos_address[j]) for j, kind in enumerate(tree.joint_types) if kind != FREE]
    return RobotMotion(float(fps), joints_in_mujoco_order(robot), qpos[:, [*base_columns(robot), *joints]])


def base_columns(robot: Robot) -> list[int]:
    """Return where the free joint's seven numbers are in a configuration of MuJoCo's model; none for a fixed base."""
    tree = robot.tree
    return [int(tree.full_qpos_address[base]) + k for base in tree.free_bases for k in range(7)]
