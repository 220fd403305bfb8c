"""Least errors of tasks of one level: configurations at rest under the weighted goals, and their derivative.

At rest the gradient ``J' W e`` of the goals is 0, but for joints that a limit stops. Preferences take no part.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..kinematics import integrate
from ..limits import ConfigurationLimit, limit_box
from ..robot._ranges import independent_balls
from ..schemes import WeightedQP
from ._minimum import inverse_hessian, minimum

_GAIN = 1e-4
"""A step that promises less, relative to the position tolerance, is the last one."""
AT_LIMIT = 1e-6
"""A joint that is nearer to its limit is at it [rad or m]: in single precision searches keep just inside."""


def ranks(search: Any) -> dict[str, int]:
    """Return the level of each task by name: -1 for hard tasks, else the priority if the scheme has priorities."""
    ranked = not isinstance(search.scheme, WeightedQP)
    return {name: -1 if task.hard else task.priority if ranked else 0 for name, task in search.tasks.items()}


def has_minimum(search: Any) -> bool:
    """Return whether goals of one level in joint ranges are all that counts, so that a sum of squares is minimised."""
    rank, ranges = ranks(search), all(isinstance(limit, ConfigurationLimit) for limit in search.limits)
    # preferences of lower levels give way to the goals
    top = all(rank[name] == min(rank.values()) for name, task in search.tasks.items() if task.is_goal or task.hard)
    return top and ranges and not independent_balls(search.robot.tree)


def settled(
    search: Any, q: Float[Array, "lanes nq"], goal: Any, open_: Bool[Array, " lanes"]
) -> tuple[Float[Array, "lanes nq"], Int[Array, " lanes"]]:
    """Return the configurations of least error that q leads to, and the steps taken; lanes that are not open stay."""
    if not has_minimum(search):
        return q, jnp.zeros(len(q), jnp.int32)
    still = jnp.zeros(search.robot.nv, q.dtype)
    weight = jax.vmap(lambda q, goal: jnp.max(_rows(search, q, still, goal)[0], initial=0.0))(q, goal)
    gain = _GAIN * search.tolerance[0] * jnp.sqrt(weight)
    lower, upper = jax.vmap(lambda q: limit_box(search.robot, q, search.limits, 1.0))(q)

    def model(motion: Float[Array, "nv lanes"]) -> tuple[Array, Array, Array]:
        return jax.vmap(lambda *lane: _model(search, *lane), (0, 1, 0), -1)(q, motion, goal)

    found = minimum(model, jnp.zeros_like(lower.T), lower.T, upper.T, open_, gain)
    moved = jax.vmap(search.after)(q, found.x.T)
    return jnp.where(open_[:, None], moved, q), found.steps


def rate_at_rest(search: Any, q: Float[Array, " nq"], goal: Any, rates: Any) -> Float[Array, " nq"]:
    """Return the derivative of a configuration at rest, for the rates of the search and the goal.

    A joint that a limit stops moves with it; of the other joints the gradient stays 0.
    """
    robot, still = search.robot, jnp.zeros(search.robot.nv, q.dtype)
    _, matrix, curved = _model(search, q, still, goal)
    gradient = _gradient(search, q, still, goal)
    lower, upper = limit_box(robot, q, search.limits, 1.0)
    low, high = (lower >= -AT_LIMIT) & (gradient >= 0.0), (upper <= AT_LIMIT) & (gradient <= 0.0)
    inverse = inverse_hessian(matrix, curved, ~(low | high))

    def slope(search: Any, goal: Any) -> tuple[Array, Array]:
        ends = limit_box(robot, q, search.limits, 1.0)
        placed = jnp.where(low, ends[0], jnp.where(high, ends[1], still))
        return placed, _gradient(search, q, placed, goal)

    _, (placed, turned) = jax.jvp(slope, (search, goal), rates)
    velocity = placed - jnp.matmul(inverse, turned, precision="highest")
    return jax.jvp(lambda motion: integrate(robot, q, motion), (still,), (velocity,))[1]


def _model(
    search: Any, q: Float[Array, " nq"], motion: Float[Array, " nv"], goal: Any
) -> tuple[Float[Array, " m"], Float[Array, "m nv"], Float[Array, "nv nv"]]:
    """Return the weighted errors after a motion from q, their Jacobian, and the rest of the Hessian."""
    weight, pull, jacobian = _rows(search, q, motion, goal)
    root = jnp.sqrt(weight)
    matrix = root[:, None] * jacobian
    hessian = jax.jacfwd(lambda motion: _gradient(search, q, motion, goal))(motion)
    return root * pull, matrix, hessian - jnp.matmul(matrix.T, matrix, precision="highest")


def _gradient(search: Any, q: Array, motion: Array, goal: Any) -> Float[Array, " nv"]:
    weight, pull, jacobian = _rows(search, q, motion, goal)
    return jnp.matmul(jacobian.T, weight * pull, precision="highest")


def _rows(search: Any, q: Array, motion: Array, goal: Any) -> tuple[Array, Array, Array]:
    """Return weights, errors and Jacobian of the goals after a motion; 0 in rows of bounds that are kept."""
    rows, _ = search.errors(integrate(search.robot, q, motion), goal)
    kept = [jnp.where((own.pull != 0.0)[:, None] | own.is_equality, own.jacobian, 0.0) for own in rows.values()]
    weight, pull = ([getattr(own, name) for own in rows.values()] for name in ("weight", "pull"))
    return jnp.concatenate(weight), jnp.concatenate(pull), jnp.concatenate(kept)
