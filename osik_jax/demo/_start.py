"""Start configuration for a user's robot: on the floor, away from limits and from stretched limbs."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..inverse import inverse_kinematics
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
which a joint stays off its limits.
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
    tasks = {foot: FrameTask(robot, foot, target=home.frame_pose(robot, foot), rows=rows) for foot in standing}
    p, R = home.frame_pose(robot, moving)
    ground = min(float(task.target[0][2]) for task in tasks.values())
    sunk = p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)])
    tasks[moving] = FrameTask(robot, moving, target=(sunk, R))
    return inverse_kinematics(robot, tasks, nearest=True, seeds=8).q


def raised(robot: Robot, q: Array, height: float) -> Float[Array, " nq"]:
    """Return the configuration with the floating base raised by a height [m]."""
    return q.at[robot.tree.qpos_address[robot.tree.free_bases[0]] + 2].add(height)


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


def _inside(robot: Robot, q: Array) -> Array:
    """Clip hinges and slides to their limits, narrowed on both sides by the margin, so that the motion has room."""
    single = [j for j in robot.tree.dof_address if robot.tree.joint_types[j] in (HINGE, SLIDE)]
    at = np.array([robot.tree.qpos_address[j] for j in single], int)
    dof = np.array([robot.tree.dof_address[j] for j in single], int)
    lower, upper = robot.position_lower[dof], robot.position_upper[dof]
    room = _MARGIN * jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
    return q.at[at].set(jnp.clip(q[at], lower + room, upper - room))
