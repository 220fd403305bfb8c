"""Controller of a live view: what a page edits, and the step that runs it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ... import control
from ..._errors import OsikTypeError, OsikWarning
from ...kinematics import forward_kinematics
from ...limits import Limit
from ...robot import Robot
from ...schemes import Scheme
from ...tasks import Task


class Controller(eqx.Module):
    """Tasks, scheme and limits of a control step, a pytree.

    Attributes:
        tasks: by name.
        scheme: how they share the robot.
        limits: hard bounds on the velocity.
    """

    tasks: dict[str, Task]
    scheme: Scheme
    limits: tuple[Limit, ...]

    def structure(self) -> tuple[Any, ...]:
        """Return what two controllers have in common that differ in numbers alone."""
        leaves, tree = jax.tree.flatten(self)
        return (tree, *((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves))


def with_targets(tasks: Mapping[str, Task], targets: Mapping[str, Any]) -> dict[str, Task]:
    """Return the tasks with some targets replaced; unknown or unsuitable targets are ignored."""
    return {name: _aimed(task, targets[name]) if name in targets else task for name, task in tasks.items()}


def targets_here(
    robot: Robot, q: Float[np.ndarray, " nq"], tasks: Mapping[str, Task], names: Iterable[str]
) -> dict[str, Any]:
    """Return the targets that the named tasks meet at q; tasks without such a target are left out."""
    kinematics, found = forward_kinematics(robot, jnp.asarray(q)), {}
    for name in tasks.keys() & set(names):
        with suppress(OsikTypeError):
            found[name] = tasks[name]._held(robot, kinematics, jnp.asarray(q)).get("target")
    return {name: jax.tree.map(np.asarray, target) for name, target in found.items() if target is not None}


def _aimed(task: Any, target: Any) -> Task:
    """Return the task with a target of the same shape, in its precision and without further checks."""
    old = getattr(task, "target", None)
    if old is None or jax.tree.map(np.shape, old) != jax.tree.map(np.shape, target):
        return task
    new = jax.tree.map(lambda own, given: jnp.asarray(given, own.dtype), old, target)
    return eqx.tree_at(lambda own: own.target, task, new)


def laid_out(robot: Robot, controller: Controller, dt: float) -> control.Controller:
    """Return the step of a controller for loops in plain Python.

    Its warnings are left out: that a weighted scheme ignores priorities is no news in a page with a menu of schemes.
    """
    with warnings.catch_warnings(action="ignore", category=OsikWarning):
        return control.Controller(robot, controller.tasks, scheme=controller.scheme, limits=controller.limits, dt=dt)
