"""The minimiser for a given active set, through a system as large as the rows of the cost, not as the variables.

Whole-body tasks have fewer rows than the robot has dofs: 18 for two feet, the centre of mass and a hand, 35 dofs of a
G1. With B the rows of A times the roots of their weights, and the active rows of C, each column over the root of its
damping (Sherman, Morrison and Woodbury),

    S z = [W^(1/2) (b - A c); d - C c],    x = c + D^(-1/2) B'z,    S = B B' + diag(1, compliance),

where x is free; the Hessian is never formed, nor factored. LAPACK takes 0.7 us for S, 3.9 for the Hessian of a G1.

What is lost: a correction cancels to a share of weight / damping roundings, and rows that depend on each other leave
nothing to S. Where the first is too much, or a pivot too small, the lane is left to the Hessian's factor.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from .._pivots import INACTIVE
from ._cost import LeastSquares
from ._factor import backward, cholesky, forward, refined
from ._problem import QP, active_targets

_WORTH = 0.9
"""Rows, as a share of the variables, beyond which the Hessian is as quick."""
_SMALLEST_PIVOT = 1e4
"""Roundings of its row's square."""
_WORST_LOSS = 1e-4
_LARGEST, _EXACT = 1e-6, 1e-13
"""The last correction is less than the first share of x, and the next would be less than the second."""


class RowFactor(NamedTuple):
    """Factors of the optimality conditions at an active set."""

    free: Bool[Array, " n"]
    held: Bool[Array, " p"]
    root: Float[Array, " n"]  # of the inverse damping, 0 where not free
    scaled: Float[Array, "m_and_p n"]  # B
    lower: Float[Array, "m_and_p m_and_p"]  # Cholesky factor of S
    loss: Float[Array, ""]  # what a correction leaves of itself to the next
    sound: Bool[Array, ""]


def has_few_rows(qp: QP) -> bool:
    """Whether this way is the shorter one; ``qp`` has a leading axis, the lanes."""
    if not isinstance(qp.cost, LeastSquares) or qp.lower.dtype != jnp.float64:
        return False
    _, m, n = qp.cost.matrix.shape
    return m + qp.rows.shape[1] <= _WORTH * n


def minimize_through_rows(
    qp: QP, active: Int[Array, "B n_and_p"]
) -> tuple[Float[Array, "B n"], Float[Array, "B p"], Bool[Array, " B"]]:
    """As ``minimize_on``, and whether the factors are worth something; every argument has a leading axis, the lanes."""
    factor = jax.vmap(_factorize)(qp, active)
    target = jax.vmap(active_targets)(qp, active)
    x, y = jax.vmap(_first)(qp, factor, target)
    root = jnp.sqrt(jax.vmap(lambda one: one.cost.diagonal())(qp))
    limit = jnp.minimum(_EXACT / factor.loss, _LARGEST)
    x, y, settled = refined(lambda x, y: jax.vmap(_correction)(qp, factor, target, x, y), x, y, root=root, limit=limit)
    return x, y, factor.sound & settled


def _factorize(qp: QP, active: Int[Array, " n_and_p"]) -> RowFactor:
    cost, n = qp.cost, active.shape[0] - qp.rows.shape[0]
    assert isinstance(cost, LeastSquares)
    free, held = active[:n] == INACTIVE, active[n:] != INACTIVE
    root = jnp.where(free, 1.0 / jnp.sqrt(cost.damping), 0.0)
    rows = jnp.concatenate([jnp.sqrt(cost.weight)[:, None] * cost.matrix, jnp.where(held[:, None], qp.rows, 0.0)])
    scaled = rows * root
    own = jnp.concatenate([jnp.ones_like(cost.weight), jnp.where(held, qp.compliance, 1.0)])
    square = product(scaled, scaled.T) + jnp.diag(own)
    lower = cholesky(square)
    unit = float(jnp.finfo(square.dtype).eps)
    squares, m = jnp.diagonal(square), len(cost.weight)
    loss = unit * jnp.max(squares[:m], initial=1.0)
    sound = jnp.all(jnp.diagonal(lower) ** 2 >= _SMALLEST_PIVOT * unit * squares) & (loss <= _WORST_LOSS)
    return RowFactor(free, held, root, scaled, lower, loss, sound)


def _solve(
    factor: RowFactor, asked: Float[Array, " m_and_p"], slope: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " m_and_p"]]:
    """dx, z with D dx - B'z = slope and B dx + diag(1, compliance) z = asked, B in the units of ``asked``."""
    pull = factor.root * slope
    z = backward(factor.lower, forward(factor.lower, asked - apply(factor.scaled, pull)))
    return factor.root * (pull + apply(factor.scaled.T, z)), z


def _first(
    qp: QP, factor: RowFactor, target: Float[Array, " n_and_p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """From the centre of the damping, where nothing large has to cancel."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    n, m = len(factor.free), len(cost.weight)
    x = jnp.where(factor.free, cost.center, target[:n])
    missed = jnp.sqrt(cost.weight) * (cost.target - apply(cost.matrix, x))
    gap = jnp.where(factor.held, target[n:] - apply(qp.rows, x), 0.0)
    dx, z = _solve(factor, jnp.concatenate([missed, gap]), jnp.zeros_like(x))
    return x + dx, z[m:]


def _correction(
    qp: QP, factor: RowFactor, target: Float[Array, " n_and_p"], x: Float[Array, " n"], y: Float[Array, " p"]
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Of x and y, from exact residuals."""
    n, m = len(x), len(factor.lower) - len(y)
    slope = apply(qp.rows.T, y) - qp.cost.gradient(x)
    gap = jnp.where(factor.held, target[n:] - apply(qp.rows, x) - qp.compliance * y, 0.0)
    dx, z = _solve(factor, jnp.concatenate([jnp.zeros(m, x.dtype), gap]), slope)
    return dx, z[m:]
