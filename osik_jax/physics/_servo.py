"""Position servos: a user's, those of the robot's model, and their actuators in MuJoCo."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import mujoco
import numpy as np

from .._errors import OsikTypeError, OsikValueError
from ..robot import Robot
from ..robot._joint_selection import select_joints
from ..robot._tree import BALL, FREE


@dataclasses.dataclass(frozen=True)
class Servo:
    """Position servo: effort = stiffness (target - position) - damping velocity, limited to +- ``effort``.

    Attributes:
        stiffness: [N m/rad or N/m].
        damping: [N m s/rad or N s/m].
        effort: the greatest torque or force [N m or N]; ``None``: the value in the robot's model, if any.
    """

    stiffness: float
    damping: float
    effort: float | None = None

    def __post_init__(self) -> None:
        if not (self.stiffness > 0.0 and math.isfinite(self.stiffness) and 0.0 <= self.damping < math.inf):
            raise OsikValueError(f"{self}: the stiffness has to be positive, the damping not negative, both finite")
        if self.effort is not None and not self.effort > 0.0:
            raise OsikValueError(f"{self}: the effort has to be positive")


def choose_servos(robot: Robot, given: Mapping[str, Servo]) -> dict[str, Servo]:
    """Return a servo, effort filled in, for each independent joint but the free one, in the order of q."""
    wrong = [servo for servo in given.values() if not isinstance(servo, Servo)]
    if wrong:
        raise OsikTypeError(f"a servo is {wrong[0]!r}; it is a Servo(stiffness, damping, effort)")
    chosen = {joint: servo for pattern, servo in given.items() for joint in select_joints(robot, pattern)}
    own, limits = _own_servos(robot.mj_model), _efforts(robot.mj_model)
    out: dict[str, Servo] = {}
    for joint in robot.tree.independent:
        name, kind = robot.tree.joint_names[joint], robot.tree.joint_types[joint]
        if kind == BALL:
            raise OsikValueError(f"joint {name!r} is a ball joint, which no servo can turn")
        if kind != FREE:
            found = chosen.get(joint, own.get(joint))
            if found is None:
                raise OsikValueError(
                    f"joint {name!r} has no position actuator in the robot's model: give servos={{{name!r}: "
                    "Servo(stiffness, damping, effort)}; a glob such as '*' stands for many"
                )
            out[name] = found if found.effort is not None else dataclasses.replace(found, effort=limits[joint])
    return out


def _own_servos(model: mujoco.MjModel) -> dict[int, Servo]:
    """Return the position actuators of a model, by joint, as seen from the joint's side of their gears."""
    out = {}
    for joint, a in _actuators(model).items():
        gain, bias = float(model.actuator_gainprm[a][0]), model.actuator_biasprm[a]
        if gain > 0.0 and bias[1] == -gain and model.actuator_gear[a, 0]:
            squared = float(model.actuator_gear[a, 0]) ** 2  # the gear is in the position and in the effort
            out[joint] = Servo(squared * gain, -squared * float(bias[2]))
    return out


def _actuators(model: mujoco.MjModel) -> dict[int, int]:
    """Return the actuator of each joint that has one."""
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    return {int(model.actuator_trnid[a][0]): int(a) for a in np.flatnonzero(on_joint)}


def _efforts(model: mujoco.MjModel) -> list[float]:
    """Return the greatest effort of each joint: that of its actuator, else that of the joint, else none."""
    actuators = _actuators(model)
    out = []
    for j in range(model.njnt):
        ranges = [model.jnt_actfrcrange[j]] if model.jnt_actfrclimited[j] else []
        if j in actuators and model.actuator_forcelimited[actuators[j]]:
            ranges.append(model.actuator_forcerange[actuators[j]] * model.actuator_gear[actuators[j], 0])
        out.append(min((float(np.abs(r).min()) for r in ranges), default=math.inf))
    return out


def add_servo(spec: mujoco.MjSpec, joint: str, servo: Servo) -> None:
    """Add an actuator named like its joint."""
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = servo.stiffness
    actuator.biasprm[1], actuator.biasprm[2] = -servo.stiffness, -servo.damping
    if servo.effort is not None and math.isfinite(servo.effort):
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = (-servo.effort, servo.effort)
