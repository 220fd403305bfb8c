"""A control step as numbers from which the core computes it without XLA: in this process, or in a file (``core/c``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ..batching._names import leaf_names
from ..kinematics._manifold import layout as manifold
from ..limits import Limit, with_own_limits
from ..robot import Robot
from ..schemes import Scheme
from ..tasks import Task, TaskRows
from ._compiled_step import Layout, missing_part, row_parts
from ._units import configuration_units, velocity_units

VERSION = 2
"""Version of a file's section ``core`` and of the layout in it; ``SECTION`` in ``core/c/controller.cpp`` is the same
number. It grows when either changes.
"""


class PackedStep(NamedTuple):
    """All numbers of a step in double precision, and where they are.

    Attributes:
        numbers: all leaves of the step's arguments, one after another.
        places: of each leaf: first number and count.
        numbered: the step's arguments with the number of each leaf in its place.
        rows: sizes and indices of the step's rows.
        layout: what ``Step`` in ``core/step.hpp`` reads.
        constants: what ``StepData`` has under this name.
        given: where the rows that JAX computes go, one task's after another's.
    """

    numbers: np.ndarray
    places: list[tuple[int, int]]
    numbered: tuple[Any, ...]
    rows: Layout
    layout: np.ndarray
    constants: np.ndarray
    given: slice

    def place(self, leaf: int) -> slice:
        """Return where the numbers of a leaf are."""
        first, count = self.places[leaf]
        return slice(first, first + count)


def pack(
    robot: Robot,
    tasks: Mapping[str, Task],
    scheme: Scheme,
    bounds: Sequence[Limit],
    dt: float,
    limit_rows: int = 0,
    given: Mapping[str, TaskRows] | None = None,
) -> PackedStep:
    """Return the step of tasks, scheme and all limits, of which the core has every part but rows that are given.

    For ``limit_rows`` rows of limits there is room in the last three leaves: Jacobian, lower and upper bounds. Of the
    rows that JAX computes, ``given`` by task, the shapes count.
    """
    arguments = arguments_of(robot, tasks, scheme, bounds, dt)
    leaves, tree = jax.tree.flatten(arguments)
    leaves = [np.asarray(leaf, np.float64).ravel() for leaf in leaves]
    numbered = jax.tree.unflatten(tree, range(len(leaves)))
    of_rows, first, before = {}, sum(map(len, leaves)), len(leaves)
    for name, own in (given or {}).items():
        parts = [None if part is None else np.zeros(part.size) for part in row_parts(own)]
        numbers = iter(range(len(leaves), len(leaves) + len(parts)))
        of_rows[name] = [-1 if part is None else next(numbers) for part in parts]
        leaves += [part for part in parts if part is not None]
    end = first + sum(map(len, leaves[before:]))
    room = np.zeros(limit_rows * robot.nv), np.full(limit_rows, -np.inf), np.full(limit_rows, np.inf)
    of_limits = [*range(len(leaves), len(leaves) + 3)] if limit_rows else []
    leaves += room if limit_rows else ()
    sizes = [len(leaf) for leaf in leaves]
    firsts = (np.cumsum(sizes) - sizes).tolist()
    rows = Layout(robot, arguments[2], scheme, given, limit_rows)
    of_one_array = {i: (0, first, size) for i, (first, size) in enumerate(zip(firsts, sizes, strict=True))}
    return PackedStep(
        np.concatenate(leaves),
        list(zip(firsts, sizes, strict=True)),
        numbered,
        rows,
        rows.integers(of_one_array, numbered, -1, of_rows, of_limits),
        rows.constants(np.dtype(np.float64)),
        slice(first, end),
    )


def arguments_of(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, bounds: Sequence[Limit], dt: float
) -> tuple[Any, ...]:
    """Return the arguments of a step; tasks in the order of a program of JAX, so that roundoff is the same."""
    return robot, robot.q0, dict(sorted(tasks.items())), scheme, tuple(bounds), dt, None


def packed_section(
    robot: Robot, tasks: Mapping[str, Task], scheme: Scheme, limits: Sequence[Limit], dt: float
) -> dict[str, Any]:
    """Return what ``osik_load`` in ``core/c`` reads: names, and all numbers of a step in double precision.

    Returns:
        ``version``, and ``missing`` alone if the core lacks a part: which one. Else ``dt``; names of the entries of
        ``q`` and ``velocity``; ``numbers``, ``layout`` and ``constants`` of ``PackedStep``; ``inputs``: name, first
        number, count and whether it is a rotation matrix, of q and of each target; ``manifold``: entries of q and of v
        that add, first entries of quaternions in q and of their rotations in v.
    """
    bounds = with_own_limits(robot, limits)
    missing = missing_part(robot, tasks, scheme, bounds)
    if missing is not None:
        return {"version": VERSION, "missing": missing}
    step = pack(robot, tasks, scheme, bounds, dt)
    targets = {name: {"target": getattr(task, "target", None)} for name, task in step.numbered[2].items()}
    inputs = [["q", *step.places[step.numbered[1]], False]]
    for name, leaf in zip(leaf_names(targets), jax.tree.leaves(targets), strict=True):
        inputs.append([name, *step.places[leaf], name.endswith(".target[1]")])
    *scalars, quaternions = manifold(robot.tree)
    return {
        "version": VERSION,
        "dt": dt,
        "q": configuration_units(robot)[0],
        "velocity": velocity_units(robot)[0],
        "inputs": inputs,
        "numbers": step.numbers.tolist(),
        "manifold": [*(part.tolist() for part in scalars), *([place[k] for place in quaternions] for k in (0, 1))],
        "layout": step.layout.tolist(),
        "constants": step.constants.tolist(),
    }
