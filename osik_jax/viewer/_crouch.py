"""Start of a walking robot: its legs slightly bent, its feet where they are at home."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..control import solve
from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ..schemes import WeightedQP
from ..tasks import FrameTask, Task

_SINK = 0.05
"""Share of the waist's height by which it is lowered over the feet."""
_BEND = 0.05
"""Share of the range by which joints first move towards its middle, so that knees bend to their possible side."""
_NUDGE = 0.1
"""First move of the legs' joints if they are stretched in the middle of their range [rad]."""
_STEPS = 40


def crouched(robot: Robot, feet: Sequence[str]) -> Float[Array, " nq"]:
    """Return the configuration with the feet of home, soles of up to two feet flat, and a lower waist. (nq,)."""
    home = forward_kinematics(robot, robot.q0)
    waist = robot.tree.body_names[robot.tree.root]
    p, R = home.frame_pose(robot, waist)
    ground = min(float(home.frame_pose(robot, foot)[0][2]) for foot in feet)
    lower = p - jnp.array([0.0, 0.0, _SINK * (float(p[2]) - ground)])
    # every step asks all errors to vanish; the feet count more, where both cannot be
    own: Any = dict(gain=1.0, orientation_weight=1.0)
    rows: Any = "pose" if len(feet) <= 2 else "position"
    tasks = {foot: FrameTask(robot, foot, rows=rows, weight=1e4, **own) for foot in feet}
    tasks |= {"waist of the start": FrameTask(robot, waist, target=(lower, R), **own)}
    found = _settled(robot, tasks, _bent(robot))
    height = forward_kinematics(robot, found).frame_pose(robot, waist)[0][2]
    if height - lower[2] < 0.5 * (p[2] - lower[2]):
        return found
    legs = np.any([np.abs(frame_jacobian(robot, home, foot)).max(0) > 0.0 for foot in feet], 0)
    nudge = _NUDGE * (legs & scalar_layout(robot)[0])
    return _settled(robot, tasks, integrate(robot, _bent(robot), jnp.asarray(nudge, robot.q0.dtype), 1.0))


def _settled(robot: Robot, tasks: Mapping[str, Task], q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    scheme = WeightedQP(curvature_damping=0.0)
    for _ in range(_STEPS):
        q = integrate(robot, q, solve(robot, q, tasks, scheme=scheme, dt=1.0).velocity, 1.0)
    return q


def _bent(robot: Robot) -> Float[Array, " nq"]:
    """Return home with limited joints moved slightly towards the middle of their range."""
    scalar, index = scalar_layout(robot)
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    limited = scalar & np.isfinite(upper - lower)
    step, span = np.zeros(robot.nv), upper[limited] - lower[limited]
    away = 0.5 * (lower[limited] + upper[limited]) - np.asarray(robot.q0)[index[limited]]
    step[limited] = np.clip(away, -_BEND * span, _BEND * span)
    return integrate(robot, robot.q0, jnp.asarray(step, robot.q0.dtype), 1.0)
