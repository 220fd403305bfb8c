"""Start configuration for an arm: above its base, away from limits and from stretched limbs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..viewer._outline import Outline
from ._sway import strides

_CLEAR = 0.04
"""Height of the links above the base, as a share of the robot's size."""
_CANDIDATES, _REACH, _MARGIN = 256, 0.8, 0.1
"""Configurations to choose from, their distance from home in strides, and the share of its range by which a joint stays
off its limits, so that the motion has room.
"""


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
