"""Derivative of the solution map, in forward and reverse mode, to any order.

Where no constraint is about to enter or leave the active set, the answer solves the KKT system at that set, which is
smooth in all data. By the implicit function theorem its derivative is one more solution of the same system
(docs/dev/derivations.md, "Implicit derivatives"); the search is not differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ...execution._backends import Backend
from ...execution._rules import custom_jvp
from ...numerics._constants import INACTIVE
from ...numerics._dense import apply
from ._dispatch import kkt_solver
from ._problem import QP, active_bounds


@cache
def with_derivative(backend: Backend) -> Callable[[Array, Array, Array, QP], tuple[Array, Array]]:
    """Return a function of x, y, the active set and the problem that returns x and y with a derivative of their own.

    Differentiated, it gives the derivatives of the minimiser and of its row multipliers by the problem's data. The KKT
    systems of the derivative are solved by ``backend``.
    """

    @custom_jvp
    def attached(x: Array, y: Array, active: Int[Array, " m"], qp: QP) -> tuple[Array, Array]:
        return x, y

    @attached.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        x, y, active, qp = primals
        x, y = attached(x, y, active, qp)
        return (x, y), _solution_rates(x, y, active, qp, tangents[3], backend)

    return attached


def _solution_rates(x: Array, y: Array, active: Array, qp: QP, rates: QP, backend: Backend) -> tuple[Array, Array]:
    """Return the rates of x and y from the rates of the problem's data."""
    n = x.shape[0]
    free, active_rows = active[:n] == INACTIVE, active[n:] != INACTIVE

    # what the rates of the data alone add to the residuals of stationarity and of the active rows
    def kkt_residuals(data: QP) -> tuple[Array, Array]:
        downhill = apply(data.rows.T, y) - data.cost.gradient(x)
        gap = active_bounds(data, active)[n:] - apply(data.rows, x) - data.compliance * y
        return downhill, gap

    _, (downhill, gap) = jax.jvp(kkt_residuals, (qp,), (rates,))
    # variables at a bound move with it
    of_bounds = jnp.where(free, 0.0, jax.jvp(lambda data: active_bounds(data, active)[:n], (qp,), (rates,))[1])
    downhill = jnp.where(free, downhill - qp.cost.hessian_product(of_bounds), 0.0)
    gap = jnp.where(active_rows, gap - apply(qp.rows, of_bounds), 0.0)
    dx, dy = _solve_kkt(qp, active, downhill, gap, backend)
    return dx + of_bounds, dy


def _solve_kkt(qp: QP, active: Int[Array, " m"], downhill: Array, gap: Array, backend: Backend) -> tuple[Array, Array]:
    """Return dx, dy with H dx - C'dy = downhill over the free variables and C dx + E dy = gap over the active rows.

    They are 0 elsewhere.
    """
    n = downhill.shape[0]
    free, active_rows = active[:n] == INACTIVE, active[n:] != INACTIVE
    in_system = jnp.concatenate([free, active_rows])

    def symmetric(point: Array) -> Array:
        x, y = jnp.where(free, point[:n], 0.0), jnp.where(active_rows, point[n:], 0.0)
        top = qp.cost.hessian_product(x) - apply(qp.rows.T, y)
        bottom = -apply(qp.rows, x) - qp.compliance * y
        return jnp.where(in_system, jnp.concatenate([top, bottom]), point)

    inverse = kkt_solver(jax.lax.stop_gradient(qp), active, backend)

    def solve(matvec: Callable[[Array], Array], right: Array) -> Array:
        return jnp.where(in_system, inverse(right), right)

    # one vector: a transposition wants all of the right side or nothing of it
    point = jax.lax.custom_linear_solve(symmetric, jnp.concatenate([downhill, -gap]), solve, symmetric=True)
    return point[:n], point[n:]
