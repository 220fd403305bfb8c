"""Path of a frame of any robot to its left and back, and a start from which an arm has room for it."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from osik_jax.demo._motion import Goal, Path, Rows, Stroke, follow
from osik_jax.kinematics import forward_kinematics, frame_jacobian, integrate
from osik_jax.robot import Robot
from osik_jax.robot._joint_selection import scalar_layout
from osik_jax.robot._mujoco import mujoco_poses
from osik_jax.robot._tree import SLIDE
from osik_jax.viewer._parts import base_height, lowest_points, robot_parts

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
_CLEAR = 0.04
"""Height of the links above the base, as a share of the robot's size."""
_CANDIDATES, _REACH, _MARGIN = 256, 0.8, 0.1
"""Configurations to choose from, their distance from home in strides, and the share of its range by which a joint stays
off its limits, so that the motion has room.
"""


class Outline(NamedTuple):
    """Dimensions of a robot at one configuration."""

    size: float  # diagonal of a box about all that is drawn of it [m]
    lowest: float  # height of its lowest point [m]
    base: float  # height of the lowest point of what is fixed to the world, 0 where nothing of that is drawn [m]


def robot_outline(robot: Robot, q: ArrayLike) -> Outline:
    """Return the dimensions of a robot at a configuration, (nq,)."""
    shape = robot_parts(robot)
    data = next(mujoco_poses(robot, q))
    heights = lowest_points(shape, data)
    size = float(np.linalg.norm(np.ptp(shape.corners(data), axis=0)))
    return Outline(size, float(heights.min()), base_height(shape, heights))


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


def dexterous_start(robot: Robot, outline: Outline, frame: str) -> Float[Array, " nq"]:
    """Return home, or a nearby configuration that moves the frame twice as well in its worst direction.

    Candidates must keep the links above the base, or as nearly as possible; a robot that hangs from its base at home
    may hang.
    """
    # a fixed seed, so that the same robot always starts in the same configuration
    steps = np.random.default_rng(0).uniform(-_REACH, _REACH, (_CANDIDATES, robot.nv)) * strides(robot, outline.size)
    steps[0] = 0.0
    rows = 6 if robot.nv >= 6 else 3
    moving = [name for name, body in zip(robot.frame_names, robot.tree.frame_bodies, strict=True) if body]

    def judged(step: Array) -> tuple[Array, Array, Array]:
        q = _inside(robot, integrate(robot, robot.q0, step, 1.0))
        kinematics = forward_kinematics(robot, q)
        J = frame_jacobian(robot, kinematics, frame)[:rows]
        heights = kinematics.frame_poses(robot, moving)[0][:, 2] - outline.base
        return q, jnp.linalg.svd(J, compute_uv=False)[-1], heights

    configurations, worst, heights = jax.jit(jax.vmap(judged))(jnp.asarray(steps, robot.q0.dtype))
    # how far links reach below the height that keeps them off the base
    below = np.maximum(_CLEAR * outline.size - np.asarray(heights), 0.0).sum(-1)
    if np.mean(heights[0]) < 0.0:
        below[:] = 0.0
    # candidates that are equally high up to 0.1 % of the size count as equal
    allowed = below <= below.min() + 1e-3 * outline.size
    worst = np.where(allowed, np.asarray(worst), -1.0)
    best = int(np.argmax(worst))
    return configurations[0 if allowed[0] and 2.0 * worst[0] >= worst[best] else best]


def _inside(robot: Robot, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """Clip hinges and slides to their limits, narrowed on both sides by a share of the range."""
    scalar, index = scalar_layout(robot)
    lower, upper = robot.position_lower[scalar], robot.position_upper[scalar]
    margin = jnp.where(jnp.isfinite(upper - lower), _MARGIN * (upper - lower), 0.0)
    return q.at[index[scalar]].set(jnp.clip(q[index[scalar]], lower + margin, upper - margin))
