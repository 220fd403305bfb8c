"""Path of a frame of any robot to its left and back, within the motion that its joints allow."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..robot import Robot
from ..robot._tree import SLIDE
from ._motion import Goal, Path, Rows, Stroke, follow

SWAY = 0.05
"""Distance of the frame's motion [m] for a robot sized between ``_SMALL`` and ``_LARGE``; the same share of the size
otherwise.
"""
_SMALL, _LARGE = 0.3, 10.0
_TURN = 0.3
"""Rotation of a joint that does not move its frame's origin [rad]."""
_KEPT: tuple[tuple[Rows, int], ...] = (("pose", 6), ("position", 3))
"""Rows of a straight path, the first that the joints can follow."""
_SINGULAR = 1e-3
"""Ratio of singular values below which a direction needs joint motions a thousand times as large as the best one."""


def sway_of(size: float) -> float:
    """Return the distance of the motion for a robot of some size [m]."""
    return SWAY * size / float(np.clip(size, _SMALL, _LARGE))


def strides(robot: Robot, size: float) -> Float[np.ndarray, " nv"]:
    """Return a large change of each dof: 1 rad, or a quarter of the robot's size for a slide [m]. (nv,)."""
    out = np.ones(robot.nv)
    for joint, dof in robot.tree.dof_address.items():
        if robot.tree.joint_types[joint] == SLIDE:
            out[dof] = 0.25 * size
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointPath(Path):
    """Path of a frame while the joints move together along a line in joint space.

    Attributes:
        robot: the robot.
        q0: start configuration. (nq,)
        frame: name of the frame.
        line: displacement of each dof at parameter 1 [rad or m]. (nv,)
        strokes: moves of the parameter along the line, 0 to 1.
    """

    robot: Robot
    q0: np.ndarray
    frame: str
    line: np.ndarray

    def at(self, t: ArrayLike | Array) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], Float[Array, "6"]]:
        """Return pose (p, R) and velocity [linear; angular] in world axes at time t [s]."""
        part, rate = follow(self.strokes, t, 1)
        q = integrate(self.robot, jnp.asarray(self.q0), jnp.asarray(self.line), part[0])
        kinematics = forward_kinematics(self.robot, q)
        velocity = frame_jacobian(self.robot, kinematics, self.frame) @ jnp.asarray(self.line) * rate
        return kinematics.frame_pose(self.robot, self.frame), velocity


def sway(robot: Robot, q0: Array, frame: str, *, size: float, duration: float) -> Goal:
    """Return a path to the frame's left and back, which keeps its orientation if the robot has enough joints.

    A frame that cannot move left moves in the direction in which its joints move it most.
    """
    kinematics = forward_kinematics(robot, q0)
    position, rotation = (np.asarray(part) for part in kinematics.frame_pose(robot, frame))
    J = np.asarray(jax.jit(frame_jacobian, static_argnums=2)(robot, kinematics, frame))
    length, stride, u = sway_of(size), strides(robot, size), duration / 8.0
    times = (0.5 * u, 3.0 * u), (4.5 * u, 7.0 * u)
    # turns count like moves of the robot's size; the orientation is kept if the robot has joints for that
    scaled = J * stride / np.repeat([size, 1.0], 3)[:, None]
    for kept, rows in _KEPT:
        if _can(scaled[:rows], length / size * np.eye(rows)[1]):
            strokes = tuple(Stroke(*time, (0.0, side * length, 0.0)) for time, side in zip(times, (1, -1), strict=True))
            return Goal(frame, Path(position, rotation, strokes), kept)
    line = _line(J, length, stride)
    rooms = [_room(robot, q0, sign * line) for sign in (1.0, -1.0)]
    line *= rooms[0] if rooms[0] >= rooms[1] else -rooms[1]
    strokes = tuple(Stroke(*time, (side,)) for time, side in zip(times, (1.0, -1.0), strict=True))
    path = JointPath(position, rotation, strokes, robot=robot, q0=np.asarray(q0), frame=frame, line=line)
    return Goal(frame, path)


def _can(J: Float[np.ndarray, "rows nv"], move: Float[np.ndarray, " rows"]) -> bool:
    """Return whether joints can make any move of these rows, and this one without long strides."""
    values = np.linalg.svd(J, compute_uv=False)
    if J.shape[0] > J.shape[1] or values[-1] <= _SINGULAR * values[0]:
        return False
    return bool(np.linalg.norm(np.linalg.lstsq(J, move, rcond=None)[0]) < 1.0)


def _line(J: Float[np.ndarray, "6 nv"], length: float, stride: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Return the line in joint space along which the frame moves most, by the length [m] and within half a stride."""
    _, values, directions = np.linalg.svd(J[:3] * stride)
    # no joint moves the frame's origin: the frame turns in place instead
    if values[0] <= 1e-9 * length:
        return _TURN * stride * np.eye(J.shape[1])[int(np.argmax(np.linalg.norm(J[3:], axis=0)))]
    return min(length / values[0], 0.5) * directions[0] * stride


def _room(robot: Robot, q0: Array, line: Float[np.ndarray, " nv"]) -> float:
    """Return the multiple of the line, 1 at most, after which a joint has used 90 % of its way to a limit."""
    q, most = np.asarray(q0), 1.0
    for joint, dof in robot.tree.dof_address.items():
        limit = float((robot.position_upper if line[dof] > 0.0 else robot.position_lower)[dof])
        if line[dof] != 0.0 and np.isfinite(limit):
            # the last tenth is kept, because near a limit the schemes slow the joint down
            most = min(most, 0.9 * (limit - float(q[robot.tree.qpos_address[joint]])) / float(line[dof]))
    return max(most, 0.0)
