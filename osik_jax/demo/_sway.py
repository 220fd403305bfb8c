"""Path of a frame of any robot to its left and back, within the motion that its joints allow."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..kinematics._home import compiled_kinematics
from ..robot import Robot
from ._motion import Goal
from ._references import Path, Stroke, follow
from ._start import strides

SWAY = 0.05
"""Distance of the frame's motion [m] for a robot sized between ``_SMALL`` and ``_LARGE``; the same share of the size
otherwise.
"""
_SMALL, _LARGE = 0.3, 10.0
_TURN = 0.3
"""Rotation of a joint that does not move its frame's origin [rad]."""


def sway_of(size: float) -> float:
    """Return the distance of the motion for a robot of some size [m]."""
    return SWAY * size / float(np.clip(size, _SMALL, _LARGE))


@dataclasses.dataclass(frozen=True)
class JointPath(Path):
    """Path of a frame while the joints move together along a line in joint space.

    Attributes:
        robot: the robot.
        q0: start configuration. (nq,)
        frame: name of the frame.
        line: displacement of each dof at parameter 1 [rad or m]. (nv,)
        along: strokes of the parameter along the line, 0 to 1.
    """

    robot: Robot | None = None
    q0: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    frame: str = ""
    line: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    along: tuple[Stroke, ...] = ()

    def at(self, t: ArrayLike | Array) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], Float[Array, "6"]]:
        """Return pose (p, R) and velocity [linear; angular] in world axes at time t [s]."""
        assert self.robot is not None
        part, rate = follow(self.along, t, 1)
        q = integrate(self.robot, jnp.asarray(self.q0), jnp.asarray(self.line), part[0])
        kinematics = forward_kinematics(self.robot, q)
        velocity = frame_jacobian(self.robot, kinematics, self.frame) @ jnp.asarray(self.line) * rate
        return kinematics.frame_pose(self.robot, self.frame), velocity

    @property
    def strokes(self) -> tuple[Stroke, ...]:
        """Return all strokes along the line."""
        return self.along


def sway(robot: Robot, q0: Array, frame: str, *, size: float, duration: float) -> Goal:
    """Return a path to the frame's left and back, with its orientation kept if the robot has enough joints.

    A frame that cannot move left moves in the direction in which its joints move it most.
    """
    kinematics = compiled_kinematics(robot, q0)
    position, rotation = (np.asarray(part) for part in kinematics.frame_pose(robot, frame))
    J = np.asarray(jax.jit(frame_jacobian, static_argnums=2)(robot, kinematics, frame))
    length, u = sway_of(size), duration / 8.0
    if not _can(J[:3], np.array([0.0, length, 0.0]), strides(robot, size)):
        line = _line(robot, q0, J, length, strides(robot, size))
        along = (Stroke(0.5 * u, 3.0 * u, (1.0,)), Stroke(4.5 * u, 7.0 * u, (-1.0,)))
        return Goal(
            frame, JointPath(position, rotation, (), (), (0.0, 1.0, 0.0), robot, np.asarray(q0), frame, line, along)
        )
    moves = (Stroke(0.5 * u, 3.0 * u, (0.0, length, 0.0)), Stroke(4.5 * u, 7.0 * u, (0.0, -length, 0.0)))
    turns = robot.nv >= 6 and _has_rank(J / np.repeat([size, 1.0], 3)[:, None])
    return Goal(frame, Path(position, rotation, moves), "pose" if turns else "position")


def _can(J: Float[np.ndarray, "3 nv"], move: Float[np.ndarray, "3"], stride: Float[np.ndarray, " nv"]) -> bool:
    """Return whether the frame can move in any direction, and by the distance without long strides of its joints."""
    scaled = J * stride
    if not _has_rank(scaled):
        return False
    return bool(np.linalg.norm(np.linalg.lstsq(scaled, move, rcond=None)[0]) < 1.0)


def _has_rank(J: Float[np.ndarray, "rows nv"]) -> bool:
    values = np.linalg.svd(J, compute_uv=False)
    # below this ratio a direction needs joint motions a thousand times as large as the best one
    return J.shape[0] <= J.shape[1] and bool(values[-1] > 1e-3 * values[0])


def _line(
    robot: Robot, q0: Array, J: Float[np.ndarray, "6 nv"], length: float, stride: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, " nv"]:
    """Return the line in joint space along which the frame moves most, within limits and strides."""
    _, values, rows = np.linalg.svd(J[:3] * stride)
    # no joint moves the frame's origin: the frame turns in place instead
    still = values[0] <= 1e-9 * length
    line = (np.eye(robot.nv)[int(np.argmax(np.linalg.norm(J[3:], axis=0)))] if still else rows[0]) * stride
    line *= _TURN if still else min(length / values[0], 0.5)
    rooms = [_room(robot, q0, sign * line) for sign in (1.0, -1.0)]
    return line * (min(rooms[0], 1.0) if rooms[0] >= min(rooms[1], 1.0) else -min(rooms[1], 1.0))


def _room(robot: Robot, q0: Array, line: Float[np.ndarray, " nv"]) -> float:
    """Return the multiple of the line after which a joint has used 90 % of its way to a limit."""
    q, most = np.asarray(q0), np.inf
    for joint, dof in robot.tree.dof_address.items():
        limit = float((robot.position_upper if line[dof] > 0.0 else robot.position_lower)[dof])
        if line[dof] != 0.0 and np.isfinite(limit):
            # the last tenth is kept, because near a limit the schemes slow the joint down
            most = min(most, 0.9 * (limit - float(q[robot.tree.qpos_address[joint]])) / float(line[dof]))
    return max(most, 0.0)
