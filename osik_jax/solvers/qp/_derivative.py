"""The derivative of the solution map, forward and reverse, to any order.

Where no constraint is about to enter or leave the active set, the answer solves a linear system that is smooth in all
data. Its derivative is one more solution of that system; the search is not differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..._rules import custom_jvp
from .._backends import Backend
from .._dense import apply
from .._pivots import INACTIVE
from ._fused import system_solver
from ._problem import QP, active_targets


@cache
def differentiable(backend: Backend) -> Callable[[Array, Array, Array, QP], tuple[Array, Array]]:
    """x and y as they are, with the derivatives of the minimiser and its row multipliers with respect to ``qp``.

    The function of x, y, the active set and the problem; ``backend`` may solve the linear systems of the derivative.
    """

    @custom_jvp
    def attached(x: Array, y: Array, active: Int[Array, " m"], qp: QP) -> tuple[Array, Array]:
        return x, y

    @attached.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        x, y, active, qp = primals
        x, y = attached(x, y, active, qp)
        return (x, y), _rates(x, y, active, qp, tangents[3], backend)

    return attached


def _rates(x: Array, y: Array, active: Array, qp: QP, rates: QP, backend: Backend) -> tuple[Array, Array]:
    """Of x and y, from those of the problem."""
    n = x.shape[0]
    free, held = active[:n] == INACTIVE, active[n:] != INACTIVE

    def conditions(data: QP) -> tuple[Array, Array]:
        slope = apply(data.rows.T, y) - data.cost.gradient(x)
        gap = active_targets(data, active)[n:] - apply(data.rows, x) - data.compliance * y
        return slope, gap

    _, (slope, gap) = jax.jvp(conditions, (qp,), (rates,))
    pinned = jnp.where(free, 0.0, jax.jvp(lambda data: active_targets(data, active)[:n], (qp,), (rates,))[1])
    slope = jnp.where(free, slope - qp.cost.curvature(pinned), 0.0)
    gap = jnp.where(held, gap - apply(qp.rows, pinned), 0.0)
    dx, dy = _linear_solve(qp, active, slope, gap, backend)
    return dx + pinned, dy


def _linear_solve(qp: QP, active: Int[Array, " m"], slope: Array, gap: Array, backend: Backend) -> tuple[Array, Array]:
    """dx, dy with H dx - C'dy = slope over the free variables and C dx + D dy = gap over the held rows, 0 elsewhere."""
    n = slope.shape[0]
    free, held = active[:n] == INACTIVE, active[n:] != INACTIVE
    counts = jnp.concatenate([free, held])

    def symmetric(point: Array) -> Array:
        x, y = jnp.where(free, point[:n], 0.0), jnp.where(held, point[n:], 0.0)
        top = qp.cost.curvature(x) - apply(qp.rows.T, y)
        bottom = -apply(qp.rows, x) - qp.compliance * y
        return jnp.where(counts, jnp.concatenate([top, bottom]), point)

    inverse = system_solver(jax.lax.stop_gradient(qp), active, backend)

    def solve(matvec: Callable[[Array], Array], right: Array) -> Array:
        return jnp.where(counts, inverse(right), right)

    # one vector: a transposition wants all of the right side or nothing of it
    point = jax.lax.custom_linear_solve(symmetric, jnp.concatenate([slope, -gap]), solve, symmetric=True)
    return point[:n], point[n:]
