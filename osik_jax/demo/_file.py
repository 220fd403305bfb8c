"""A waist or hand motion for a robot that somebody brings along."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._feet import find_feet
from .._tree import HINGE, SLIDE
from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..limits import ConfigurationLimit, VelocityLimit
from ..robot import Robot
from ..tasks import ComTask, FrameTask, PostureTask, SupportPolygon, Task, support_polygon
from ._motion import GAIN, Goal, Motion, Stance, along, contact_corners, tracking
from ._references import Path, Stroke

SWAY = 0.05
"""How far the frame goes to its left [m]."""
_MARGIN = 0.01
_SINK = 0.05
"""A standing robot first bends its legs: its waist goes down by this part of its height over the feet."""
_HANDS = (r"tcp|tool|gripper|end_?effector|\bee\b", r"hand", r"flange|wrist")


def file_motion(
    robot: Robot,
    *,
    name: str,
    frame: str | None = None,
    support: Sequence[str] = (),
    duration: float = 8.0,
) -> Motion:
    """A frame goes 5 cm to its left and back, while the supporting frames, if any, stay.

    Args:
        robot: the robot.
        name: for people.
        frame: what moves; ``None``: the floating base, or the tip of a robot that is bolted down.
        support: frames on the ground; none: those of a floating robot that look like feet.
        duration: [s].

    Raises:
        KeyError: no such frame; the message lists those that exist.
        ValueError: a floating robot of which no frame looks like a foot, or the moving frame is one that stands.
    """
    moving = guess_moving_frame(robot) if frame is None else frame
    standing = tuple(support) or (guess_feet(robot) if robot.floating_base else ())
    for chosen in (moving, *standing):
        robot.tree.frame(chosen)
    if robot.floating_base and not standing:
        raise ValueError(
            "the base floats and none of the frames looks like a foot: say which ones stand with --support NAME..., or "
            "--base fixed; "
            f"frames: {', '.join(robot.frame_names)}"
        )
    if moving in standing:
        raise ValueError(f"frame {moving!r} cannot both move and stand; choose another --frame or --support")
    q0 = _start(robot, moving, standing)
    polygon, notes = _polygon(robot, q0, standing)
    flat = _foot_rows(standing) == "pose"
    stances = tuple(Stance(foot, _corners(robot, foot), flat=flat) for foot in standing)
    goal = Goal(moving, _sway(robot, q0, moving, duration), "pose" if robot.nv >= 6 else "position")
    still, follower = _tasks(robot, q0, goal, standing, polygon)
    label = "waist" if robot.floating_base else "hand"
    return Motion(
        name="waist" if robot.floating_base else "hand",
        title=f"{name}: {moving} sways",
        robot=robot,
        q0=q0,
        tasks=lambda t: still | {label: along(follower, goal, t)},
        duration=duration,
        stances=stances,
        goals={label: goal},
        limits=(ConfigurationLimit(robot), VelocityLimit(robot)),
        balanced=polygon is not None,
        notes=notes,
    )


def guess_moving_frame(robot: Robot) -> str:
    """The free joint's body; without one, the deepest frame that sounds like a tool or hand, else the last body."""
    tree = robot.tree
    if robot.floating_base:
        return tree.body_names[tree.body_parents.index(0, 1)]
    depth = [0] * len(tree.body_parents)
    for body, parent in enumerate(tree.body_parents[1:], 1):
        depth[body] = depth[parent] + 1
    for pattern in _HANDS:
        found = [k for k, name in enumerate(tree.frame_names) if re.search(pattern, name, re.IGNORECASE)]
        if found:
            return tree.frame_names[max(found, key=lambda k: depth[tree.frame_bodies[k]])]
    return tree.body_names[depth.index(max(depth))]


def guess_feet(robot: Robot) -> tuple[str, ...]:
    """Frames with contact corners; else those of different bodies, without children, that sound like feet."""
    tree = robot.tree
    with_corners = tuple(
        name.removesuffix("_corner_0")
        for name in tree.frame_names
        if name.endswith("_corner_0") and name.removesuffix("_corner_0") in tree.frame_names
    )
    if with_corners:
        return with_corners
    return find_feet(zip(tree.frame_names, tree.frame_bodies, strict=True), tree.body_parents)


def _corners(robot: Robot, foot: str) -> Float[np.ndarray, "k 3"]:
    """Contact corners in the frame [m]; a foot without any touches the ground at its origin."""
    known = contact_corners(robot, foot)
    return known if len(known) else np.zeros((1, 3))


def _polygon(robot: Robot, q0: Array, standing: Sequence[str]) -> tuple[SupportPolygon | None, tuple[str, ...]]:
    """The support polygon where the feet have corners, or are enough to span one; and a remark where not."""
    if not standing:
        return None, ()
    corners = {foot: _corners(robot, foot) for foot in standing}
    if sum(len(points) for points in corners.values()) < 3:
        known = f"no contact corners are known of {', '.join(standing)} (sites NAME_corner_0, NAME_corner_1, ...)"
        return None, (f"{known}, so balance is neither asked for nor reported",)
    return support_polygon(robot, q0, standing, margin=_MARGIN, corners=corners), ()


def _tasks(
    robot: Robot, q0: Array, goal: Goal, standing: Sequence[str], polygon: SupportPolygon | None
) -> tuple[dict[str, Task], FrameTask]:
    """What stands still, and the task that moves."""
    kinematics = forward_kinematics(robot, q0)
    still: dict[str, Task] = {
        foot: FrameTask(
            robot, foot, target=kinematics.frame_pose(robot, foot), rows=_foot_rows(standing), weight=1e4, gain=GAIN
        )
        for foot in standing
    }
    if polygon is not None:
        still["com"] = ComTask(robot, polygon=polygon, weight=1e3, gain=GAIN, priority=2)
    still["posture"] = PostureTask(robot, target=q0, weight=1e-2, gain=1.0, priority=4)
    return still, tracking(robot, goal, weight=1e2, priority=3)


def _foot_rows(standing: Sequence[str]) -> Literal["pose", "position"]:
    """One or two feet stand on soles; more of them stand on points."""
    return "pose" if len(standing) <= 2 else "position"


def _sway(robot: Robot, q0: Array, frame: str, duration: float) -> Path:
    """To the left of the world and back."""
    position, rotation = forward_kinematics(robot, q0).frame_pose(robot, frame)
    u = duration / 8.0
    moves = (Stroke(0.5 * u, 3.0 * u, (0.0, SWAY, 0.0)), Stroke(4.5 * u, 7.0 * u, (0.0, -SWAY, 0.0)))
    return Path(np.asarray(position), np.asarray(rotation), moves)


def _start(robot: Robot, moving: str, standing: Sequence[str]) -> Float[Array, " nq"]:
    """Home, away from joint limits and stretched limbs: the waist sinks a little, or the arm bends."""
    if not standing:
        return _dexterous(robot, moving)
    home = forward_kinematics(robot, robot.q0)
    targets = {foot: home.frame_pose(robot, foot) for foot in standing}
    p, R = home.frame_pose(robot, moving)
    ground = min(float(pose[0][2]) for pose in targets.values())
    targets[moving] = (p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)]), R)
    return _settled(robot, _bent(robot), targets, _foot_rows(standing))


def _bent(robot: Robot) -> Float[Array, " nq"]:
    """Home with every limited joint moved towards the middle of its range, by a twentieth of the range at most."""
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    q0, step = np.asarray(robot.q0), np.zeros(robot.nv)
    for joint, dof in robot.tree.dof_address.items():
        if np.isfinite(upper[dof] - lower[dof]):
            away = 0.5 * (lower[dof] + upper[dof]) - q0[robot.tree.qpos_address[joint]]
            step[dof] = np.clip(away, -0.05 * (upper[dof] - lower[dof]), 0.05 * (upper[dof] - lower[dof]))
    return integrate(robot, robot.q0, jnp.asarray(step, robot.q0.dtype), 1.0)


def _dexterous(robot: Robot, frame: str, count: int = 64, reach: float = 0.8) -> Float[Array, " nq"]:
    """Home, unless a configuration near it moves the frame twice as well in its worst direction."""
    steps = np.random.default_rng(0).uniform(-reach, reach, (count, robot.nv)) * (np.arange(count) > 0)[:, None]
    rows = 6 if robot.nv >= 6 else 3

    def judged(step: Array) -> tuple[Array, Array]:
        q = _inside(robot, integrate(robot, robot.q0, step, 1.0), margin=0.1)
        J = frame_jacobian(robot, forward_kinematics(robot, q), frame)[:rows]
        return q, jnp.linalg.svd(J, compute_uv=False)[-1]

    configurations, worst = jax.jit(jax.vmap(judged))(jnp.asarray(steps, robot.q0.dtype))
    best = jnp.argmax(worst)
    return configurations[jnp.where(2.0 * worst[0] >= worst[best], 0, best)]


def _settled(
    robot: Robot, q: Array, targets: dict[str, tuple[Array, Array]], rows: Literal["pose", "position"]
) -> Float[Array, " nq"]:
    """Damped Gauss-Newton steps to the poses, the last of which counts least, from q and a few nudged starts.

    A leg that is stretched at q, with no limit to tell which way its knee bends, only bends from a nudged one.
    """
    last = len(targets) - 1
    tasks = [
        FrameTask(robot, frame, target=pose, rows="pose" if k == last else rows, weight=1e-4 if k == last else 1.0)
        for k, (frame, pose) in enumerate(targets.items())
    ]

    def step(q: Array) -> tuple[Array, Array]:
        kinematics = forward_kinematics(robot, q)
        parts = [task.rows(robot, kinematics, q) for task in tasks]
        scale = jnp.sqrt(jnp.concatenate([part.weight for part in parts]))
        e = scale * jnp.concatenate([part.error for part in parts])
        J = scale[:, None] * jnp.concatenate([part.jacobian for part in parts])
        v = -J.T @ jnp.linalg.solve(J @ J.T + 1e-7 * jnp.eye(len(e)), e)
        return _inside(robot, integrate(robot, q, v, 1.0)), jnp.sum(e**2)

    def settle(nudge: Array) -> tuple[Array, Array]:
        start = _inside(robot, integrate(robot, q, nudge, 1.0))
        ends, errors = jax.lax.scan(lambda x, _: step(x), start, length=100)
        return ends, errors[-1]

    nudges = np.random.default_rng(0).uniform(-0.4, 0.4, (8, robot.nv))
    nudges[0], nudges[:, :6] = 0.0, 0.0  # the base stays
    ends, errors = jax.jit(jax.vmap(settle))(jnp.asarray(nudges, q.dtype))
    return ends[jnp.argmin(jnp.where(errors < 0.5 * errors[0], errors, errors[0]))]


def _inside(robot: Robot, q: Array, *, margin: float = 0.0) -> Array:
    """Clips hinges and slides to their limits, drawn in by a part of their range."""
    single = [j for j in robot.tree.dof_address if robot.tree.joint_types[j] in (HINGE, SLIDE)]
    at = np.array([robot.tree.qpos_address[j] for j in single], int)
    dof = np.array([robot.tree.dof_address[j] for j in single], int)
    lower, upper = robot.position_lower[dof], robot.position_upper[dof]
    room = margin * jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
    return q.at[at].set(jnp.clip(q[at], lower + room, upper - room))
