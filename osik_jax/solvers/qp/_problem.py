"""The quadratic program and its answer, as pytrees."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

INACTIVE, AT_LOWER, AT_UPPER, EQUALITY = 0, -1, 1, 2


class QP(eqx.Module):
    """min 1/2 x'Hx + g'x  over  lower <= [x; C x] <= upper.

    Attributes:
        hessian: H, symmetric positive definite. (n, n)
        gradient: g. (n,)
        rows: C; p may be 0. (p, n)
        lower: lower bounds of x, then of the rows; -inf allowed. (n + p,)
        upper: upper bounds; inf allowed, equal to the lower for an equality. (n + p,)
    """

    hessian: Float[Array, "n n"]
    gradient: Float[Array, " n"]
    rows: Float[Array, "p n"]
    lower: Float[Array, " n+p"]
    upper: Float[Array, " n+p"]

    @property
    def equality(self) -> Bool[Array, " n+p"]:
        """Constraints whose bounds are equal."""
        return self.lower == self.upper

    def values(self, x: Float[Array, " n"]) -> Float[Array, " n+p"]:
        """[x; C x]."""
        return jnp.concatenate([x, self.rows @ x])


class QPSolution(eqx.Module):
    """Answer of a quadratic program.

    Attributes:
        x: the minimiser; inside its box exactly, whatever the status. (n,)
        status: a ``Status`` code.
        iterations: constraints added to or dropped from the active set.
        kkt_residual: the largest of: stationarity (infinity norm), violated rows, multipliers of the wrong sign.
        multipliers: of the box: gradient of the cost = multipliers + C' row_multipliers; positive at a lower bound,
            negative at an upper. (n,)
        row_multipliers: of the rows, same signs. (p,)
        active: -1 at the lower bound, 1 at the upper, 2 equality, 0 free; of x, then of the rows. (n + p,)
    """

    x: Float[Array, " n"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    multipliers: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " n+p"]
