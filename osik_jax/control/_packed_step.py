"""A control step as numbers that JSON holds, from which the core computes it without Python (``core/c``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from ..batching._names import leaf_names
from ..kinematics._manifold import layout as manifold
from ..limits import AccelerationLimit, Limit, with_own_limits
from ..robot import Robot
from ..schemes import Scheme
from ..tasks import Task
from ._compiled_step import Layout, unknown_part
from ._units import configuration_units, velocity_units

VERSION = 2
"""Version of a file's section ``core`` and of the layout in it; ``SECTION`` in ``core/c/controller.cpp`` is the same
number. It grows when either changes.
"""


def packed_step(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, limits: Sequence[Limit], dt: float
) -> dict[str, Any]:
    """Return what ``osik_load`` in ``core/c`` reads: names, and all numbers of a step in double precision.

    Args:
        robot: the robot.
        tasks: by name.
        scheme: how they share the robot.
        limits: beside the robot's own.
        dt: time of a step [s].

    Returns:
        ``version``, and ``missing`` alone if the core lacks a part: which one. Else ``dt``; names of the entries of
        ``q`` and ``velocity``; ``numbers``: all leaves of the arguments of a step, one after another; ``inputs``: name,
        first number, count and whether it is a rotation matrix, of q and of each target; ``manifold``: entries of q and
        of v that add, first entries of quaternions in q and of their rotations in v; ``layout`` and ``constants``: what
        ``Step`` in ``core/step.hpp`` takes.
    """
    bounds = with_own_limits(robot, limits)
    missing = unknown_part(robot, tasks, scheme, bounds)
    if any(isinstance(limit, AccelerationLimit) for limit in bounds):  # the core takes it as a box, made in JAX
        missing = missing or "the limit AccelerationLimit"
    if missing is not None:
        return {"version": VERSION, "missing": missing}
    given = robot, robot.q0, dict(tasks), scheme, bounds, dt, None
    leaves, tree = jax.tree.flatten(given)
    leaves = [np.asarray(leaf, np.float64).ravel() for leaf in leaves]
    ends = np.cumsum([len(leaf) for leaf in leaves])
    places = {i: (0, int(end) - len(leaf), len(leaf)) for i, (leaf, end) in enumerate(zip(leaves, ends, strict=True))}
    numbered, step = jax.tree.unflatten(tree, range(len(leaves))), Layout(robot, tasks, scheme)
    targets = {name: {"target": getattr(task, "target", None)} for name, task in numbered[2].items()}
    inputs = [["q", *places[numbered[1]][1:], False]]
    for name, leaf in zip(leaf_names(targets), jax.tree.leaves(targets), strict=True):
        inputs.append([name, *places[leaf][1:], name.endswith(".target[1]")])
    *scalars, quaternions = manifold(robot.tree)
    return {
        "version": VERSION,
        "dt": dt,
        "q": configuration_units(robot)[0],
        "velocity": velocity_units(robot)[0],
        "inputs": inputs,
        "numbers": np.concatenate(leaves).tolist(),
        "manifold": [*(part.tolist() for part in scalars), *([place[k] for place in quaternions] for k in (0, 1))],
        "layout": step.integers(places, numbered, -1).tolist(),
        "constants": step.constants(np.dtype(np.float64)).tolist(),
    }
