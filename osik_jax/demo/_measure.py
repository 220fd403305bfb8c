"""Quality of a motion, recomputed by MuJoCo's C code from the configurations alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from ..robot import Robot
from ..tasks._polygon import Polygon, hull
from ..viewer._mujoco import mujoco_frame_pose, mujoco_poses, robot_com
from ._motion import Motion, Stance

TOLERANCE = 1e-9
"""Excess over a limit that counts as a violation [rad or m; relative for speeds]."""
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


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
    poses, com, qpos = _look(robot, q, [part.frame for part in (*motion.stances, *motion.goals.values())])
    wanted, goals = {}, {}
    for label, goal in motion.goals.items():
        wanted[label] = tuple(np.asarray(part) for part in jax.jit(jax.vmap(goal.path.at))(time)[0])
        settled = goal.path.still(time)
        goals[label] = _track(poses[goal.frame], wanted[label], settled, turns=goal.rows == "pose")
    hulls = _hulls(motion, poses, time) if motion.balanced else []
    position_margin, position_violations = _position_limits(robot.mj_model, qpos)
    velocity_margin, velocity_violations = _velocity_limits(robot, qpos, dt)
    return Measurement(
        time=time,
        stances={s.frame: _drift(poses[s.frame], s, time) for s in motion.stances},
        goals=goals,
        com=com,
        com_margin=margins(com[:, :2], hulls),
        support=[vertices for _, _, vertices in hulls],
        displacement={label: poses[g.frame][0] - poses[g.frame][0][0] for label, g in motion.goals.items()},
        wanted={label: position - position[0] for label, (position, _) in wanted.items()},
        position_margin=position_margin,
        velocity_margin=velocity_margin,
        position_violations=position_violations,
        velocity_violations=velocity_violations,
    )


_Poses = tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"]]


def _look(robot: Robot, q: np.ndarray, frames: list[str]) -> tuple[dict[str, _Poses], np.ndarray, np.ndarray]:
    """Return the frames' poses, the centre of mass and MuJoCo's qpos at every configuration."""
    seen, com, qpos = {name: [] for name in frames}, [], []
    for data in mujoco_poses(robot, q):
        for name, poses in seen.items():
            poses.append(mujoco_frame_pose(robot, data, name))
        com.append(robot_com(robot, data))
        qpos.append(data.qpos.copy())
    poses = {name: (np.array([p for p, _ in rows]), np.array([R for _, R in rows])) for name, rows in seen.items()}
    return poses, np.array(com), np.array(qpos)


def _track(poses: _Poses, wanted: _Poses, settled: np.ndarray, *, turns: bool) -> Track:
    """Return the distances between two sequences of poses."""
    between = np.einsum("tij,tkj->tik", poses[1], wanted[1])
    # twice the sine and the cosine of the angle, plus 1: accurate for small angles too
    axis = np.stack([between[:, k - 1, k - 2] - between[:, k - 2, k - 1] for k in range(3)], -1)
    angle = np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(between, axis1=1, axis2=2) - 1.0)
    position = np.linalg.norm(poses[0] - wanted[0], axis=-1)
    return Track(position, angle if turns else np.full_like(angle, np.nan), settled)


def _drift(poses: _Poses, stance: Stance, time: np.ndarray) -> Track:
    """Return a standing frame's distance from its first pose; NaN while it is in the air."""
    standing = stance.on_ground(time)
    track = _track(poses, (poses[0][:1], np.broadcast_to(poses[1][:1], poses[1].shape)), standing, turns=stance.flat)
    position, orientation = (np.where(standing, x, np.nan) for x in (track.position, track.orientation))
    return Track(position, orientation, standing)


def _hulls(motion: Motion, poses: dict[str, _Poses], time: np.ndarray) -> list[Polygon]:
    """Return the hull of the corners on the ground at each time, at the feet's first poses."""
    corners = {s.frame: poses[s.frame][0][0] + s.corners @ poses[s.frame][1][0].T for s in motion.stances}
    standing = np.stack([s.on_ground(time) for s in motion.stances], -1)
    hulls: dict[tuple[bool, ...], Polygon] = {}
    for row in {tuple(row) for row in standing}:
        points = [corners[s.frame][:, :2] for s, down in zip(motion.stances, row, strict=True) if down]
        found = hull(np.concatenate(points))
        assert found is not None  # support_polygon has refused corners that span no area
        hulls[row] = found
    return [hulls[tuple(row)] for row in standing]


def margins(points: Float[np.ndarray, "T 2"], hulls: Sequence[Polygon | None]) -> Float[np.ndarray, " T"]:
    """Return the least signed distance of points to the edge lines of hulls [m], positive inside; NaN without hull."""
    pairs = zip(points, hulls, strict=False)
    return np.array([np.nan if edges is None else np.min(edges[1] - edges[0] @ point) for point, edges in pairs])


def _position_limits(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the margin over the limited hinges and slides of the model, coupled joints included, and violations."""
    joints = np.flatnonzero(model.jnt_limited.astype(bool) & np.isin(model.jnt_type, _SINGLE))
    value = qpos[:, model.jnt_qposadr[joints]]
    lower, upper = model.jnt_range[joints].T
    room = np.minimum(value - lower, upper - value)
    # the guard keeps a joint with an empty range finite
    margin = np.min(2.0 * room / np.maximum(upper - lower, 1e-12), -1, initial=1.0)
    return margin, int((room < -TOLERANCE).sum())


def _velocity_limits(robot: Robot, qpos: np.ndarray, dt: float) -> tuple[np.ndarray, int]:
    """Return the margin of the speeds between configurations by MuJoCo, and violations.

    A coupled joint's limit is in its leader's.
    """
    model = robot.mj_model
    speed = np.zeros((len(qpos) - 1, model.nv))
    for row, a, b in zip(speed, qpos[:-1], qpos[1:], strict=True):
        mujoco.mj_differentiatePos(model, row, dt, a, b)
    own, _ = robot.tree.dof_columns[0]
    limit = np.asarray(robot.velocity_limit)
    bounded = np.isfinite(limit)
    used = np.abs(speed[:, own][:, bounded]) / limit[bounded]
    return 1.0 - used.max(-1, initial=0.0), int((used > 1.0 + TOLERANCE).sum())
