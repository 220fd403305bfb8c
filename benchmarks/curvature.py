"""How near the bound on a position's curvature is to the truth: its ratio to the greatest eigenvalue.

    python -m benchmarks.curvature

In random configurations, and for errors in random directions, the bound of ``osik_jax/tasks/_curvature.py`` is divided
by the greatest absolute eigenvalue of the second derivative of the hand's place along the error: central differences of
MuJoCo C's Jacobian. A step is stable from a ratio of 0.5 on.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from osik_jax.runtime import configure_cpu
from osik_jax.tasks._curvature import pose_curvature

from .descriptions import ROBOTS
from .peers._mujoco import Coordinates
from .robots import workload

STEP = 1e-5
"""Of the differences [rad]."""


def ratios(name: str, count: int) -> np.ndarray:
    """Of one robot, at ``count`` configurations that are uniform in its joints' ranges; the base can turn. (count,)."""
    work, rng = workload(name), np.random.default_rng(0)
    coordinates, base = Coordinates(work), 7 if work.floating else 0
    model, body = coordinates.model, coordinates.model.body(work.hand).id
    data, bound = mujoco.MjData(model), jax.jit(pose_curvature)
    found = []
    for _ in range(count):
        canonical, error = work.start.copy(), rng.normal(size=3)
        canonical[base:] = rng.uniform(work.position_lower, work.position_upper)
        q = coordinates.own(canonical)
        jacobian = jnp.asarray(_jacobian(model, data, q, body))
        exact = _second_derivative(model, data, q, body, error)
        found.append(float(bound(jnp.asarray(error), jnp.zeros(3), jacobian)) / np.abs(np.linalg.eigvalsh(exact)).max())
    return np.array(found)


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray, body: int) -> np.ndarray:
    """Of a body's origin, [linear; angular]. (6, nv)."""
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    found = np.zeros((6, model.nv))
    mujoco.mj_jacBody(model, data, found[:3], found[3:], body)
    return found


def _second_derivative(
    model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray, body: int, error: np.ndarray
) -> np.ndarray:
    """Of error . place along straight lines of the tangent space: what J changes by, its symmetric part. (nv, nv)."""
    rows = []
    for step in STEP * np.eye(model.nv):
        ends = []
        for sign in (1.0, -1.0):
            moved = q.copy()
            mujoco.mj_integratePos(model, moved, step, sign)
            ends.append(_jacobian(model, data, moved, body)[:3])
        rows.append(error @ (ends[0] - ends[1]) / (2.0 * STEP))
    return 0.5 * (np.array(rows) + np.array(rows).T)


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.curvature", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="configurations of each robot")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    table = Table("robot", "least", "1 % are below", "median", "99 % are below", "greatest")
    for name in ROBOTS:
        found = ratios(name, given.count)
        table.add_row(name, *(f"{value:.2f}" for value in np.percentile(found, (0, 1, 50, 99, 100))))
    Console(width=100).print(table)


if __name__ == "__main__":
    configure_cpu()
    main()
