"""What a scheme is given and what it answers."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..solvers import Level
from ..solvers._dense import apply
from ..tasks import TaskRows
from ..tasks._leaves import as_scalar


class VelocityProblem(eqx.Module):
    """One tick: what the tasks ask of the velocity, and its box.

    Attributes:
        rows: of each task, by name.
        priorities: of each task, by name; 1 first (static).
        lower: of v, -inf where free. (nv,)
        upper: of v, inf where free. (nv,)
        position: of each dof [rad or m], 0 for ball and free joints. (nv,)
        position_lower: of each dof, -inf where free or no ``ConfigurationLimit`` was given. (nv,)
        position_upper: likewise, inf where free. (nv,)
    """

    rows: dict[str, TaskRows]
    priorities: tuple[tuple[str, int], ...] = eqx.field(static=True)
    lower: Float[Array, " nv"]
    upper: Float[Array, " nv"]
    position: Float[Array, " nv"]
    position_lower: Float[Array, " nv"]
    position_upper: Float[Array, " nv"]

    def by_priority(self) -> list[list[str]]:
        """Names of the tasks of each priority, most important first."""
        ranks = sorted({rank for _, rank in self.priorities})
        return [[name for name, own in self.priorities if own == rank] for rank in ranks]

    def level(self, names: list[str]) -> Level:
        """The rows of some tasks as one level."""
        rows = [self.rows[name] for name in names]
        matrix, lower, upper, weight = (
            jnp.concatenate([getattr(r, field) for r in rows]) for field in ("jacobian", "lower", "upper", "weight")
        )
        return Level(matrix, lower, upper, weight, [r.is_equality for r in rows for _ in r.error])

    def slack(self, velocity: Float[Array, " nv"]) -> dict[str, Float[Array, " m"]]:
        """Of each task, J v minus the nearest point of its interval."""
        dense = {name: rows for name, rows in self.rows.items() if rows.dofs is None}
        values = {name: velocity[np.array(rows.dofs, int)] for name, rows in self.rows.items() if name not in dense}
        if dense:
            together = apply(jnp.concatenate([rows.jacobian for rows in dense.values()]), velocity)
            ends = np.cumsum([len(rows.error) for rows in dense.values()])[:-1]
            values |= dict(zip(dense, jnp.split(together, ends), strict=True))
        return {name: values[name] - jnp.clip(values[name], r.lower, r.upper) for name, r in self.rows.items()}


class SchemeAnswer(eqx.Module):
    """What a scheme says of one tick; see ``Solution`` for the fields."""

    velocity: Float[Array, " nv"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    warm_start: Any = None


class Scheme(eqx.Module):
    """Base of the schemes: how tasks that cannot all be met share the robot."""

    @abc.abstractmethod
    def solve(self, problem: VelocityProblem, warm_start: Any = None) -> SchemeAnswer:
        """The velocity of one tick.

        Args:
            problem: the tick.
            warm_start: what the answer to a tick nearby had in ``warm_start``; integers, all zeros for a cold start. It
                changes the time that the answer takes, and not the answer.
        """


def as_leaf(name: str) -> Callable[[ArrayLike | Array], Float[Array, ""]]:
    """Converter of a scheme's number to a traced leaf; negative or not finite raises ValueError with its name."""
    return lambda value: as_scalar(value, name)
