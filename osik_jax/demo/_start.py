"""Start configuration for a user's robot: on the floor, away from limits and from stretched limbs."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..kinematics._home import home_kinematics
from ..robot import Robot
from ..robot._tree import HINGE, SLIDE
from ..tasks import FrameTask
from ..viewer._outline import Outline
from ._motion import Rows
from ._sway import strides

_SINK = 0.05
"""Share of the waist's height by which a standing robot first bends its legs."""
_CLEAR = 0.04
"""Height of the links of a fixed robot above its base, as a share of its size."""
_CANDIDATES, _REACH, _MARGIN = 256, 0.8, 0.1
"""Configurations to choose from for a fixed robot, their distance from home in strides, and the share of its range by
which a joint stays off its limits, so that the motion has room.
"""


def start(robot: Robot, outline: Outline, moving: str, standing: Sequence[str], rows: Rows) -> Float[Array, " nq"]:
    """Return the home configuration, changed where the waist must sink or an arm must bend or rise above its base.

    Args:
        robot: the robot.
        outline: of the robot at home.
        moving: the frame that will move.
        standing: frames on the ground; none for a robot that is bolted down.
        rows: rows of the feet that stay.
    """
    if not standing:
        return _dexterous(robot, outline, moving)
    home = home_kinematics(robot)
    poses = {foot: home.frame_pose(robot, foot) for foot in standing}
    feet = [FrameTask(robot, foot, target=pose, rows=rows, orientation_weight=1.0) for foot, pose in poses.items()]
    p, R = home.frame_pose(robot, moving)
    ground = min(float(foot.target[0][2]) for foot in feet)
    sunk = p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)])
    # the waist has the least weight: it only picks one of the configurations that keep the feet
    waist = FrameTask(robot, moving, target=(sunk, R), weight=1e-4)
    legs = np.any([np.abs(frame_jacobian(robot, home, foot)).max(0) > 0.0 for foot in standing], 0)
    return _settled(robot, [*feet, waist], legs * strides(robot, outline.size))


def raised(robot: Robot, q: Array, height: float) -> Float[Array, " nq"]:
    """Return the configuration with the floating base raised by a height [m]."""
    return q.at[robot.tree.qpos_address[robot.tree.free_bases[0]] + 2].add(height)


def _settled(robot: Robot, tasks: Sequence[FrameTask], stride: Float[np.ndarray, " nv"]) -> Float[Array, " nq"]:
    """Return the configuration after damped Gauss-Newton steps to the tasks' targets, from home.

    A stretched leg whose knee has no limit to tell its side bends from a perturbed start only. Such a start counts
    where its error is less than half.
    """

    def step(q: Array, _: None) -> tuple[Array, Array]:
        kinematics = forward_kinematics(robot, q)
        parts = [task.rows(robot, kinematics, q) for task in tasks]
        scale = jnp.sqrt(jnp.concatenate([part.weight for part in parts]))
        e = scale * jnp.concatenate([part.error for part in parts])
        J = scale[:, None] * jnp.concatenate([part.jacobian for part in parts])
        # the damping keeps steps finite where legs are stretched and J loses rank
        v = -J.T @ jnp.linalg.solve(J @ J.T + 1e-7 * jnp.eye(len(e)), e)
        return _inside(robot, integrate(robot, q, v, 1.0), 0.0), jnp.sum(e**2)

    def settle(nudge: Array) -> tuple[Array, Array]:
        q = _inside(robot, integrate(robot, _bent(robot), nudge, 1.0), 0.0)
        end, errors = jax.lax.scan(step, q, length=100)
        return end, errors[-1]

    # a fixed seed, so that the same robot always starts in the same configuration; the base stays
    nudges = np.random.default_rng(0).uniform(-0.4, 0.4, (8, robot.nv)) * stride
    nudges[0], nudges[:, :6] = 0.0, 0.0
    ends, errors = jax.jit(jax.vmap(settle))(jnp.asarray(nudges, robot.q0.dtype))
    return ends[jnp.argmin(jnp.where(errors < 0.5 * errors[0], errors, errors[0]))]


def _dexterous(robot: Robot, outline: Outline, frame: str) -> Float[Array, " nq"]:
    """Return home, or a nearby configuration that moves the frame twice as well in its worst direction.

    Candidates must keep the links above the base, or as nearly as possible; a robot that hangs from its base at home
    may hang.
    """
    steps = np.random.default_rng(0).uniform(-_REACH, _REACH, (_CANDIDATES, robot.nv)) * strides(robot, outline.size)
    steps[0] = 0.0
    rows = 6 if robot.nv >= 6 else 3
    moving = [name for name, body in zip(robot.frame_names, robot.tree.frame_bodies, strict=True) if body]

    def judged(step: Array) -> tuple[Array, Array, Array]:
        q = _inside(robot, integrate(robot, robot.q0, step, 1.0), _MARGIN)
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


def _bent(robot: Robot) -> Float[Array, " nq"]:
    """Return home with every limited joint moved towards the middle of its range, by at most 5 % of the range."""
    at, lower, upper, span = _ranges(robot)
    home = robot.q0[at]
    away = jnp.where(span > 0.0, 0.5 * (lower + upper) - home, 0.0)
    return robot.q0.at[at].set(home + jnp.clip(away, -0.05 * span, 0.05 * span))


def _inside(robot: Robot, q: Array, margin: float) -> Array:
    """Clip hinges and slides to their limits, narrowed on both sides by a share of the range."""
    at, lower, upper, span = _ranges(robot)
    return q.at[at].set(jnp.clip(q[at], lower + margin * span, upper - margin * span))


def _ranges(robot: Robot) -> tuple[np.ndarray, Array, Array, Array]:
    """Return the places of hinges and slides in q, their limits, and their ranges, 0 without limits. (k,) each."""
    single = [j for j in robot.tree.dof_address if robot.tree.joint_types[j] in (HINGE, SLIDE)]
    at = np.array([robot.tree.qpos_address[j] for j in single], int)
    dof = np.array([robot.tree.dof_address[j] for j in single], int)
    lower, upper = robot.position_lower[dof], robot.position_upper[dof]
    return at, lower, upper, jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
