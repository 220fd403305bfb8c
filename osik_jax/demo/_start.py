"""Start configuration for a user's robot: on the floor, away from limits and from stretched limbs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..kinematics._home import compiled_kinematics
from ..robot import Robot
from ..robot._tree import HINGE, SLIDE
from ..tasks import FrameTask
from ..viewer._outline import Outline

_SINK = 0.05
"""Share of the waist's height by which a standing robot first bends its legs."""
_CLEAR = 0.04
"""Height of the links of a fixed robot above its base, as a share of its size."""
Rows = Literal["pose", "position"]


def start(robot: Robot, outline: Outline, moving: str, standing: Sequence[str], rows: Rows) -> Float[Array, " nq"]:
    """Return the home configuration, changed where the waist must sink or an arm must bend or rise above its base.

    Args:
        robot: the robot.
        outline: of the robot at home.
        moving: the frame that will move.
        standing: frames on the ground; none for a robot that is bolted down.
        rows: what of the feet counts.
    """
    if not standing:
        return _dexterous(robot, outline, moving)
    home = forward_kinematics(robot, robot.q0)
    targets = {foot: home.frame_pose(robot, foot) for foot in standing}
    p, R = home.frame_pose(robot, moving)
    ground = min(float(pose[0][2]) for pose in targets.values())
    targets[moving] = (p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)]), R)
    return _settled(robot, _bent(robot), targets, rows, outline.size)


def raised(robot: Robot, q: Array, height: float) -> Float[Array, " nq"]:
    """Return the configuration with the floating base raised by a height [m]."""
    return q.at[robot.tree.qpos_address[robot.tree.free_bases[0]] + 2].add(height)


def _bent(robot: Robot) -> Float[Array, " nq"]:
    """Return home with every limited joint moved towards the middle of its range, by at most 5 % of the range."""
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    q0, step = np.asarray(robot.q0), np.zeros(robot.nv)
    for joint, dof in robot.tree.dof_address.items():
        if robot.tree.joint_types[joint] in (HINGE, SLIDE) and np.isfinite(upper[dof] - lower[dof]):
            away = 0.5 * (lower[dof] + upper[dof]) - q0[robot.tree.qpos_address[joint]]
            step[dof] = np.clip(away, -0.05 * (upper[dof] - lower[dof]), 0.05 * (upper[dof] - lower[dof]))
    return integrate(robot, robot.q0, jnp.asarray(step, robot.q0.dtype), 1.0)


def strides(robot: Robot, size: float) -> Float[np.ndarray, " nv"]:
    """Return a large change of each dof: 1 rad, or a quarter of the robot's size for a slide [m]. (nv,)."""
    out = np.ones(robot.nv)
    for joint, dof in robot.tree.dof_address.items():
        if robot.tree.joint_types[joint] == SLIDE:
            out[dof] = 0.25 * size
    return out


def _dexterous(robot: Robot, outline: Outline, frame: str, count: int = 256, reach: float = 0.8) -> Float[Array, " nq"]:
    """Return home, or a nearby configuration that moves the frame twice as well in its worst direction.

    Candidates must keep the links above the base, or as nearly as possible; a robot that hangs from its base at home
    may hang.
    """
    steps = np.random.default_rng(0).uniform(-reach, reach, (count, robot.nv)) * (np.arange(count) > 0)[:, None]
    steps *= strides(robot, outline.size)
    rows = 6 if robot.nv >= 6 else 3
    moving = [name for name, body in zip(robot.frame_names, robot.tree.frame_bodies, strict=True) if body]

    def judged(step: Array) -> tuple[Array, Array, Array]:
        # candidates stay off the limits, so that the motion has room
        q = _inside(robot, integrate(robot, robot.q0, step, 1.0), margin=0.1)
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
    judged_worst = np.where(allowed, np.asarray(worst), -1.0)
    best = int(np.argmax(judged_worst))
    return configurations[0 if allowed[0] and 2.0 * judged_worst[0] >= judged_worst[best] else best]


def _settled(
    robot: Robot, q: Array, targets: dict[str, tuple[Array, Array]], rows: Rows, size: float
) -> Float[Array, " nq"]:
    """Return the configuration after damped Gauss-Newton steps to the poses, from q and a few perturbed starts.

    The last pose has the least weight. A stretched leg whose knee has no limit to tell its side bends from a perturbed
    start only.
    """
    last = len(targets) - 1
    tasks = [
        # the last pose (the waist) only picks one of the solutions that keep the feet
        FrameTask(robot, frame, target=pose, rows="pose" if k == last else rows, weight=1e-4 if k == last else 1.0)
        for k, (frame, pose) in enumerate(targets.items())
    ]

    def step(q: Array) -> tuple[Array, Array]:
        kinematics = forward_kinematics(robot, q)
        parts = [task.rows(robot, kinematics, q) for task in tasks]
        scale = jnp.sqrt(jnp.concatenate([part.weight for part in parts]))
        e = scale * jnp.concatenate([part.error for part in parts])
        J = scale[:, None] * jnp.concatenate([part.jacobian for part in parts])
        # the damping keeps steps finite where legs are stretched and J loses rank
        v = -J.T @ jnp.linalg.solve(J @ J.T + 1e-7 * jnp.eye(len(e)), e)
        return _inside(robot, integrate(robot, q, v, 1.0)), jnp.sum(e**2)

    def settle(nudge: Array) -> tuple[Array, Array]:
        start = _inside(robot, integrate(robot, q, nudge, 1.0))
        ends, errors = jax.lax.scan(lambda x, _: step(x), start, length=100)
        return ends, errors[-1]

    # a fixed seed, so that the same robot always starts in the same configuration
    nudges = np.random.default_rng(0).uniform(-0.4, 0.4, (8, robot.nv)) * strides(robot, size)
    nudges *= _leg_dofs(robot, q, tuple(targets)[:last])
    nudges[0], nudges[:, :6] = 0.0, 0.0  # the base stays
    ends, errors = jax.jit(jax.vmap(settle))(jnp.asarray(nudges, q.dtype))
    return ends[jnp.argmin(jnp.where(errors < 0.5 * errors[0], errors, errors[0]))]


def _leg_dofs(robot: Robot, q: Array, feet: Sequence[str]) -> np.ndarray:
    """Return which dofs move one of the feet. (nv,)."""
    kinematics = compiled_kinematics(robot, q)
    moved = [np.asarray(frame_jacobian(robot, kinematics, foot)) for foot in feet]
    return np.abs(np.concatenate(moved)).max(0) > 0.0


def _inside(robot: Robot, q: Array, *, margin: float = 0.0) -> Array:
    """Clip hinges and slides to their limits, narrowed by a share of their range."""
    single = [j for j in robot.tree.dof_address if robot.tree.joint_types[j] in (HINGE, SLIDE)]
    at = np.array([robot.tree.qpos_address[j] for j in single], int)
    dof = np.array([robot.tree.dof_address[j] for j in single], int)
    lower, upper = robot.position_lower[dof], robot.position_upper[dof]
    room = margin * jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
    return q.at[at].set(jnp.clip(q[at], lower + room, upper - room))
