"""Errors of the tasks that say where something has to be, in metres and radians."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..inverse._task_search import is_goal, sizes_of
from ..kinematics import forward_kinematics
from ..robot import Robot
from ..tasks import Task
from ..tasks._rows import rows_of


def goals_of(tasks: Mapping[str, Task]) -> dict[str, Task]:
    """Return the tasks that have to be met, with a gain of 1: their pull is then their error."""
    return {
        name: task.replace(gain=1.0) for name, task in tasks.items() if is_goal(task) and "gain" in task.replaceable
    }


def errors_of(robot: Robot, q: Float[Array, " nq"], tasks: Mapping[str, Task]) -> dict[str, Float[Array, "2"]]:
    """Return the error of each goal at q: metres (or the task's own unit), and radians; of bounds, the part outside."""
    goals = goals_of(tasks)
    rows = rows_of(robot, forward_kinematics(robot, q), q, goals)
    return {name: jnp.stack(sizes_of(goals[name], own)) for name, own in rows.items()}


def as_tolerances(position: Any, orientation: Any) -> Float[np.ndarray, "2"]:
    """Return both tolerances; raise ValueError unless they are positive numbers."""
    found = np.array([position, orientation], float)
    if not (np.isfinite(found) & (found > 0.0)).all():
        raise OsikValueError(f"the tolerances are {position!r} m and {orientation!r} rad; both are positive numbers")
    return found


def check_concrete(where: str, *given: Any) -> None:
    """Raise ValueError for numbers that are traced: a verdict is text, made outside of jit."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given)):
        raise OsikValueError(f"{where} has traced arguments; a verdict is text: call it outside of jit, vmap and grad")


def in_words(error: Float[np.ndarray, "2"]) -> str:
    """Return an error in metres and radians as text."""
    return f"{error[0]:.3g} m and {error[1]:.3g} rad"
