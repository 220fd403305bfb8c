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
_STEP = 1e-3
"""Time to run, simulate and measure one step [s]."""
_SIMULATED = 4.0
"""Factor on the time of a step with physics."""
_PICTURE, _MESH_PICTURE = 0.15, 0.5
"""Time to draw one film picture on one core [s], of simple shapes and of meshes."""
# rate of the film's pictures [1/s]
_PICTURES_PER_SECOND = 12.5


def estimate_seconds(
    motion: Motion,
    *,
    schemes: Sequence[str],
    dt: float,
    animation: bool = True,
    physics: bool = False,
) -> float:
    """Return the estimated run time of a demonstration [s], from the compile time of a part of it.

    Args:
        motion: what to do.
        schemes: names from ``SCHEMES``.
        dt: control period [s].
        animation: whether a film is drawn.
        physics: whether MuJoCo simulates the motion.
    """
    reference, delay = _reference(motion)
    compiling = reference * sum(_COMPILE[scheme] for scheme in schemes)
    steps = len(schemes) * motion.duration / dt * _STEP * (_SIMULATED if physics else 1.0)
    picture = _PICTURE if motion.look is None else _MESH_PICTURE
    pictures = min(_PICTURES_PER_SECOND, 1.0 / dt) * motion.duration if animation else 0.0
    return compiling + delay * (steps + pictures * picture / (os.cpu_count() or 1))


def _reference(motion: Motion) -> tuple[float, float]:
    """Return the compile time of the tasks' rows [s], and the ratio of elapsed to processor time.

    The ratio shows how much other programs slow this process down.
    """

    def rows(q: Float[Array, " nq"]) -> list[Array]:
        kinematics = forward_kinematics(motion.robot, q)
        parts = [task.rows(motion.robot, kinematics, q) for task in motion.tasks(0.0).values()]
        return [part.error for part in parts] + [part.jacobian for part in parts]

    start, worked = time.perf_counter(), time.process_time()
    jax.jit(rows).lower(motion.q0).compile()
    seconds = time.perf_counter() - start
    # compilation uses several threads, so processor time may exceed elapsed time: the ratio is at least 1
    return seconds, max(1.0, seconds / max(time.process_time() - worked, 1e-3))
