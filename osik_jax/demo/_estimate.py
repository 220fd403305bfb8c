"""Estimate of a demonstration's run time, printed before it starts."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

import jax
from jaxtyping import Array, Float

from ..kinematics import forward_kinematics
from ._motion import Motion

_COMPILE = {"weighted": 8.0, "null-space": 5.0, "hierarchical": 12.0}
"""Compile time of a scheme's loop relative to that of its tasks' rows."""
_STEP, _SIMULATED_STEP = 1e-3, 4e-3
"""Time to run and measure one step, and one with physics [s]."""
_PICTURE, _MESH_PICTURE = 0.15, 2.0
"""Time to draw one film picture on one core [s], of simple shapes and of meshes."""
_PICTURES_PER_SECOND = 12.5


def estimate_seconds(
    motion: Motion, *, schemes: Sequence[str], dt: float, animation: bool = True, physics: bool = False
) -> float:
    """Return the estimated run time of a demonstration [s], from the compile time of a part of it.

    Args:
        motion: what to do.
        schemes: names of the schemes.
        dt: control period [s].
        animation: whether a film is drawn.
        physics: whether MuJoCo simulates the motion.
    """

    def rows(q: Float[Array, " nq"]) -> list[tuple[Array, Array]]:
        kinematics = forward_kinematics(motion.robot, q)
        parts = [task.rows(motion.robot, kinematics, q) for task in motion.tasks(0.0).values()]
        return [(part.error, part.jacobian) for part in parts]

    start = time.perf_counter()
    jax.jit(rows).lower(motion.q0).compile()
    compiling = (time.perf_counter() - start) * sum(_COMPILE[scheme] for scheme in schemes)
    steps = len(schemes) * motion.duration / dt * (_SIMULATED_STEP if physics else _STEP)
    pictures = min(_PICTURES_PER_SECOND, 1.0 / dt) * motion.duration if animation else 0.0
    drawing = pictures * (_PICTURE if motion.robot.holder.look is None else _MESH_PICTURE)
    return compiling + steps + drawing / (os.cpu_count() or 1)
