"""Quality of a motion, recomputed by MuJoCo's C code from the configurations alone."""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np
import scipy.spatial
from jaxtyping import Float

from ..robot import Robot
from ..viewer import mujoco_frame_pose, mujoco_poses, robot_com
from ._motion import Motion
from ._references import Path

TOLERANCE = 1e-9
"""Excess over a limit that counts as a violation [rad or m; relative for speeds]."""


@dataclasses.dataclass(frozen=True)
class Track:
    """Distance of a frame from its reference at every configuration; NaN where it has none.

    Attributes:
        position: [m]. (T,)
        orientation: angle [rad]. (T,)
        settled: whether the reference has moved and stands again. (T,)
    """

    position: Float[np.ndarray, " T"]
    orientation: Float[np.ndarray, " T"]
    settled: np.ndarray


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Figures of a motion.

    Attributes:
        time: [s]. (T,)
        stances: drift of each standing frame from its first pose.
        goals: distance of each goal's frame from its path.
        com: centre of mass [m]. (T, 3)
        com_margin: distance of its ground projection to the nearest edge of the support polygon [m], positive inside;
            empty without a polygon. (T,) or (0,)
        support: vertices of the support polygon [m], counter-clockwise; empty without one.
        displacement: displacement of each goal's frame from its first position [m]. (T, 3)
        wanted: displacement of its path [m]. (T, 3)
        position_margin: least distance of a joint to a limit relative to half its range: 1 in the middle,
            0 at the limit, negative beyond. (T,)
        velocity_margin: the same for speeds: 1 at rest, 0 at the limit. (T - 1,)
        position_violations: joints times steps beyond a limit.
        velocity_violations: joints times steps beyond a limit.
    """

    time: Float[np.ndarray, " T"]
    stances: dict[str, Track]
    goals: dict[str, Track]
    com: Float[np.ndarray, "T 3"]
    com_margin: Float[np.ndarray, " T"]
    support: list[Float[np.ndarray, "m 2"]]
    displacement: dict[str, Float[np.ndarray, "T 3"]]
    wanted: dict[str, Float[np.ndarray, "T 3"]]
    position_margin: Float[np.ndarray, " T"]
    velocity_margin: Float[np.ndarray, " steps"]
    position_violations: int
    velocity_violations: int


def measure(motion: Motion, q: Float[np.ndarray, "T nq"], dt: float) -> Measurement:
    """Compare configurations ``dt`` [s] apart with the references of a motion."""
    robot, time = motion.robot, dt * np.arange(len(q))
    frames = list(dict.fromkeys([s.frame for s in motion.stances] + [g.frame for g in motion.goals.values()]))
    poses, com, qpos = _look(robot, q, frames)
    stances = {s.frame: _drift(poses[s.frame], s.on_ground(time), flat=s.flat) for s in motion.stances}
    paths = {label: _path(goal.path, time) for label, goal in motion.goals.items()}
    goals = {
        label: _track(poses[goal.frame], paths[label], goal.path.still(time), turns=goal.rows == "pose")
        for label, goal in motion.goals.items()
    }
    support = _support(motion, poses, time)
    position_margin, position_violations = _position_limits(robot.mj_model, qpos)
    velocity_margin, velocity_violations = _velocity_limits(robot, qpos, dt)
    return Measurement(
        time=time,
        stances=stances,
        goals=goals,
        com=com,
        com_margin=margins(com, support),
        support=support,
        displacement={k: poses[g.frame][0] - poses[g.frame][0][0] for k, g in motion.goals.items()},
        wanted={label: path[0] - path[0][0] for label, path in paths.items()},
        position_margin=position_margin,
        velocity_margin=velocity_margin,
        position_violations=position_violations,
        velocity_violations=velocity_violations,
    )


_Poses = tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"]]


def _look(robot: Robot, q: np.ndarray, frames: list[str]) -> tuple[dict[str, _Poses], np.ndarray, np.ndarray]:
    """Return the frames' poses, the centre of mass and MuJoCo's qpos at every configuration."""
    seen, com, qpos = [], [], []
    for data in mujoco_poses(robot, q):
        seen.append([mujoco_frame_pose(robot, data, name) for name in frames])
        com.append(robot_com(robot, data))
        qpos.append(data.qpos.copy())
    poses = {
        name: (np.array([row[k][0] for row in seen]), np.array([row[k][1] for row in seen]))
        for k, name in enumerate(frames)
    }
    return poses, np.array(com), np.array(qpos)


def _path(path: Path, time: np.ndarray) -> _Poses:
    (position, rotation), _ = jax.jit(jax.vmap(path.at))(time)
    return np.asarray(position), np.asarray(rotation)


def _angle(a: Float[np.ndarray, "T 3 3"], b: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """Return the angle of the rotation between two rotation matrices [rad], accurate for small angles."""
    between = np.einsum("tij,tkj->tik", a, b)
    axis = np.stack(
        [between[:, 2, 1] - between[:, 1, 2], between[:, 0, 2] - between[:, 2, 0], between[:, 1, 0] - between[:, 0, 1]],
        -1,
    )
    return np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(between, axis1=1, axis2=2) - 1.0)


def _track(poses: _Poses, wanted: _Poses, settled: np.ndarray, *, turns: bool) -> Track:
    angle = _angle(poses[1], wanted[1])
    return Track(
        np.linalg.norm(poses[0] - wanted[0], axis=-1), angle if turns else np.full_like(angle, np.nan), settled
    )


def _drift(poses: _Poses, standing: np.ndarray, *, flat: bool) -> Track:
    """Return a standing frame's distance from its first pose; NaN while it is in the air."""
    first = np.broadcast_to(poses[0][:1], poses[0].shape), np.broadcast_to(poses[1][:1], poses[1].shape)
    track = _track(poses, first, standing, turns=flat)
    position, orientation = (np.where(standing, x, np.nan) for x in (track.position, track.orientation))
    return Track(position, orientation, standing)


def _support(motion: Motion, poses: dict[str, _Poses], time: np.ndarray) -> list[np.ndarray]:
    """Return the vertices of the hull of the corners on the ground, at the feet's first poses [m]."""
    if not motion.balanced:
        return []
    corners = {s.frame: poses[s.frame][0][0] + s.corners @ poses[s.frame][1][0].T for s in motion.stances}
    standing = np.stack([s.on_ground(time) for s in motion.stances], -1)
    hulls = {}
    for row in {tuple(row) for row in standing}:
        points = np.concatenate([corners[s.frame] for s, down in zip(motion.stances, row, strict=True) if down])[:, :2]
        hulls[row] = points[scipy.spatial.ConvexHull(points).vertices]
    return [hulls[tuple(row)] for row in standing]


def margins(com: np.ndarray, support: list[np.ndarray]) -> np.ndarray:
    """Return the least signed distance of points to the polygon's edge lines [m], positive inside."""
    out = []
    for point, vertices in zip(com[:, :2], support, strict=False):
        edges = np.roll(vertices, -1, 0) - vertices
        inward = np.stack([-edges[:, 1], edges[:, 0]], -1) / np.linalg.norm(edges, axis=-1, keepdims=True)
        out.append(np.min(np.sum(inward * (point - vertices), -1)))
    return np.array(out)


def _position_limits(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the range of every limited hinge and slide of the model, coupled joints included."""
    joints = [
        j
        for j in range(model.njnt)
        if model.jnt_limited[j]
        and model.jnt_type[j] in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    ]
    if not joints:
        return np.ones(len(qpos)), 0
    value = qpos[:, model.jnt_qposadr[joints]]
    lower, upper = model.jnt_range[joints].T
    room = np.minimum(value - lower, upper - value)
    # the guard keeps a joint with an empty range finite
    return np.min(2.0 * room / np.maximum(upper - lower, 1e-12), -1), int((room < -TOLERANCE).sum())


def _velocity_limits(robot: Robot, qpos: np.ndarray, dt: float) -> tuple[np.ndarray, int]:
    """Return speeds between configurations by MuJoCo, and their limits; a coupled joint's limit is in its leader's."""
    model = robot.mj_model
    speed = np.zeros((len(qpos) - 1, model.nv))
    for row, a, b in zip(speed, qpos[:-1], qpos[1:], strict=True):
        mujoco.mj_differentiatePos(model, row, dt, a, b)
    own, _ = robot.tree.dof_columns[0]
    limit = np.asarray(robot.velocity_limit)
    bounded = np.isfinite(limit)
    if not bounded.any():
        return np.ones(len(speed)), 0
    used = np.abs(speed[:, own][:, bounded]) / limit[bounded]
    return 1.0 - used.max(-1), int((used > 1.0 + TOLERANCE).sum())
