"""Control step, compiled once: targets, gains and weights are arguments, so new ones compile nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._errors import OsikTypeError, OsikValueError
from ...control._checks import checked_limits
from ...control._rollout import remembering
from ...control._step import in_type_of
from ...control._step import step as one_step
from ...kinematics import forward_kinematics, integrate
from ...limits import Limit
from ...robot import Robot
from ...schemes import Scheme
from ...tasks import Task

State = tuple[Array, Array, Any]
"""State passed from step to step: configuration (nq,), velocity (nv,) and warm start."""


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

    def numbers(self) -> list[Array]:
        """Return the numbers that may change without compiling, in a fixed order."""
        return [leaf if isinstance(leaf, jax.Array) else jnp.asarray(leaf) for leaf in jax.tree.leaves(self)]

    def structure(self) -> tuple[Any, ...]:
        """Return a key of the compiled program: controllers with equal structure share a program."""
        leaves, tree = jax.tree.flatten(self)
        return (tree, *((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves))


def with_targets(controller: Controller, targets: Mapping[str, Any]) -> Controller:
    """Return the controller with some targets replaced; unknown or unsuitable targets are ignored."""
    aimed = {name: _aimed(task, targets[name]) for name, task in controller.tasks.items() if name in targets}
    return dataclasses.replace(controller, tasks={**controller.tasks, **aimed}) if aimed else controller


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


@dataclasses.dataclass(frozen=True)
class Program:
    """Compiled control step."""

    # from the controller's numbers and the state to the next state, status and task errors
    run: Callable[[list[Array], State], tuple[State, Array, dict[str, Array]]]
    cold: Any  # the warm start of a first step


def compile_step(robot: Robot, controller: Controller, dt: float, batch: int | None = None) -> Program:
    """Compile one step of a controller in the calling thread; takes seconds.

    For a batch, all numbers and states have a leading axis.
    """
    tree = jax.tree.structure(controller)
    numbers, lead = controller.numbers(), () if batch is None else (batch,)

    def step(numbers: list[Array], state: State) -> tuple[State, Array, dict[str, Array]]:
        own = jax.tree.unflatten(tree, numbers)
        q, velocity, warm_start = state
        tasks, limits = remembering((own.tasks, own.limits), velocity, True)
        # not `solve`, which warns of a weighted scheme's ignored priorities: the page has a menu of schemes
        answer = one_step(robot, q, tasks, own.scheme, checked_limits(robot, limits), in_type_of(dt, q), warm_start)
        moved = integrate(robot, q, answer.velocity, dt)
        return (moved, answer.velocity, answer.warm_start), answer.status, answer.error

    run = step if batch is None else jax.vmap(step)
    q, still = jnp.broadcast_to(robot.q0, (*lead, robot.nq)), jnp.zeros((*lead, robot.nv), robot.q0.dtype)
    traced = jax.eval_shape(run, numbers, (q, still, None))
    cold = jax.tree.map(jnp.zeros_like, traced[0][2])
    return Program(jax.jit(run).lower(numbers, (q, still, cold)).compile(), cold)


def stacked(controllers: Sequence[Controller]) -> Controller:
    """Return one controller for a batch; each number has a leading axis."""
    first = controllers[0]
    if any(one.structure() != first.structure() for one in controllers):
        raise OsikValueError(
            "the robots of a batch differ in more than numbers: they need tasks of the same names and kinds"
        )
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *controllers)
