"""What the methods share: the answer, what a level asks for at a point, and inputs that can be computed with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply
from ..hqp import Level
from ._padded import Rows

RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}


class NullSpaceSolution(eqx.Module):
    """Answer of the projection.

    Attributes:
        x: the answer; with bounds, inside them exactly, whatever the status. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: SOLVED; INFEASIBLE where bounds cross (their middle stands for them);
            NUMERICAL_ERROR where the input cannot be computed with (x is then 0, clipped to its bounds);
            with bounds, MAX_ITERATIONS where the search for the saturated joints was cut short.
        projector: onto what no level asks for; without bounds, the secondary motion went through it. (n, n)
        scales: of each level, the share s of its motion that the bounds leave room for; 1 without bounds. (k,)
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


class Demand(NamedTuple):
    """What a level asks for at a point: the rows that count there (the others are 0) and by how much they should move.

    ``cutoff`` is the length that these rows, projected, have at least outside of the span of the longer ones; those
    with less count as dependent.
    """

    rows: Float[Array, "m n"]
    wanted: Float[Array, " m"]
    cutoff: Float[Array, ""]

    @classmethod
    def of(cls, level: Level | Rows, x: Float[Array, " n"], rank: Array | float) -> Demand:
        """Equalities count always, inequalities where x violates them."""
        value, equal = apply(level.matrix, x), level.equal
        # clip shares its derivative among bounds that are equal
        wanted = jnp.where(equal, level.lower, jnp.clip(value, level.lower, level.upper)) - value
        counts = equal | (wanted != 0.0)
        rows = jnp.where(counts[:, None], level.matrix, 0.0)
        return cls(rows, wanted, rank * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2)))


def sane(levels: Sequence[Level], *more: Array) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN, and infinities only where a bound may be absent."""
    checks = [jnp.isfinite(level.matrix).all() for level in levels]
    checks += [((level.lower < jnp.inf) & (level.upper > -jnp.inf)).all() for level in levels]
    checks += [jnp.isfinite(level.weight).all() for level in levels if level.weight is not None]
    return jnp.stack([*checks, *(jnp.isfinite(array).all() for array in more)]).all()
