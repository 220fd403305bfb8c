"""Common parts of the methods: answer, and residual of a level."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...numerics._dense import apply
from .._level import Level, PaddedLevel


class NullSpaceSolution(eqx.Module):
    """Answer of the projection.

    Attributes:
        x: the answer; with bounds, inside them exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: SOLVED; INFEASIBLE where bounds cross (their middle stands for them);
            NUMERICAL_ERROR where the data are not finite (x is then 0, clipped to its bounds);
            with bounds, MAX_ITERATIONS where the search for the saturated joints was cut short.
        projector: onto the null space of all levels; without bounds, the secondary motion went through it. (n, n)
        scales: of each level, the largest part s of its motion that the bounds allow; 1 without bounds. (k,)
        active: -1 at the lower bound, 1 at the upper, 2 pinned by equal bounds, 0 free. (n,)
        iterations: of the search for the saturated joints, all levels together; 0 without bounds.
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    projector: Float[Array, "n n"]
    scales: Float[Array, " k"]
    active: Int[Array, " n"]
    iterations: Int[Array, ""]


class ActiveTask(NamedTuple):
    """Rows of a level that are active at a point (0 for others), and the error they should remove.

    ``cutoff`` is the smallest pivot of these rows, projected, that is not 0: rows that have less outside the span of
    the longer ones count as dependent.
    """

    rows: Float[Array, "m n"]
    error: Float[Array, " m"]
    cutoff: Float[Array, ""]

    @classmethod
    def at(cls, level: Level | PaddedLevel, x: Float[Array, " n"], rank_tol: Array | float) -> ActiveTask:
        """Return the rows active at x: equalities always, inequalities if x violates them."""
        value, equal = apply(level.matrix, x), level.equal
        # a clip halves its derivative between equal bounds
        error = jnp.where(equal, level.lower, jnp.clip(value, level.lower, level.upper)) - value
        is_active = equal | (error != 0.0)
        rows = jnp.where(is_active[:, None], level.matrix, 0.0)
        return cls(rows, error, rank_tol * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2)))
