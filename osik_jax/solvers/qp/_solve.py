"""solve_qp and solve_least_squares_qp: find the active set, solve exactly on it, certify."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._status import Status
from ._dual_active_set import ActiveSet, find_active_set
from ._exact import Gradient, solve_active_set
from ._problem import AT_LOWER, AT_UPPER, INACTIVE, QP, QPSolution

_VIOLATION = {jnp.dtype("float64"): 1e-12, jnp.dtype("float32"): 1e-6}
_FEASIBLE = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-5}


@partial(jax.jit, static_argnames="max_iterations")
def solve_qp(
    hessian: Float[ArrayLike, "n n"],
    gradient: Float[ArrayLike, " n"],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    rows: Float[ArrayLike, "p n"] | None = None,
    rows_lower: Float[ArrayLike, " p"] | None = None,
    rows_upper: Float[ArrayLike, " p"] | None = None,
    *,
    max_iterations: int | None = None,
    tolerance: float | None = None,
) -> QPSolution:
    """Minimises 1/2 x'Hx + g'x  subject to  lower <= x <= upper,  rows_lower <= rows x <= rows_upper.

    Pure, compiled on first use, and batched by ``vmap``. Derivatives with respect to every array, in both modes, are
    those of the solution map at its active set.

    Args:
        hessian: H, symmetric positive definite. (n, n)
        gradient: g. (n,)
        lower: -inf where unbounded; equal to ``upper`` pins x. (n,)
        upper: inf where unbounded. (n,)
        rows: general constraints. (p, n)
        rows_lower: lower bounds of the rows; equal bounds make an equality. (p,)
        rows_upper: upper bounds of the rows. (p,)
        max_iterations: cap on changes of the active set (static); default 10 (n + p).
        tolerance: relative violation that counts as none; default 1e-12 (1e-6 in float32).

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.
    """
    hessian, gradient = jnp.asarray(hessian), jnp.asarray(gradient)
    qp = _problem(hessian, gradient, lower, upper, rows, rows_lower, rows_upper)
    return _solve(qp, lambda x: qp.hessian @ x + qp.gradient, max_iterations, tolerance)


@partial(jax.jit, static_argnames="max_iterations")
def solve_least_squares_qp(
    matrix: Float[ArrayLike, "m n"],
    target: Float[ArrayLike, " m"],
    weight: Float[ArrayLike, " m"],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    rows: Float[ArrayLike, "p n"] | None = None,
    rows_lower: Float[ArrayLike, " p"] | None = None,
    rows_upper: Float[ArrayLike, " p"] | None = None,
    *,
    damping: Float[ArrayLike, "..."] = 1e-9,
    max_iterations: int | None = None,
    tolerance: float | None = None,
) -> QPSolution:
    """Minimises 1/2 sum_i weight_i (matrix_i x - target_i)^2 + 1/2 damping |x|^2, constrained as in ``solve_qp``.

    The factored form: the answer is refined against residuals of the matrix itself, so that small weights survive
    beside large ones.

    Args:
        matrix: A. (m, n)
        target: b. (m,)
        weight: of the squared residuals, >= 0. (m,)
        damping: > 0; makes the answer unique. A scalar or one per variable (n,).
        lower: as in ``solve_qp``, and so are the following.
        upper: of the box. (n,)
        rows: general constraints. (p, n)
        rows_lower: of the rows. (p,)
        rows_upper: of the rows. (p,)
        max_iterations: cap on changes of the active set (static).
        tolerance: relative violation that counts as none.
    """
    matrix, target, weight = jnp.asarray(matrix), jnp.asarray(target), jnp.asarray(weight)
    diagonal = jnp.broadcast_to(jnp.asarray(damping, matrix.dtype), matrix.shape[1:])
    hessian = jnp.matmul(matrix.T * weight, matrix, precision="highest") + jnp.diag(diagonal)
    gradient = -jnp.matmul(matrix.T, weight * target, precision="highest")
    qp = _problem(hessian, gradient, lower, upper, rows, rows_lower, rows_upper)

    def cost_gradient(x: Float[Array, " n"]) -> Float[Array, " n"]:
        residual = weight * (jnp.matmul(matrix, x, precision="highest") - target)
        return jnp.matmul(matrix.T, residual, precision="highest") + diagonal * x

    return _solve(qp, cost_gradient, max_iterations, tolerance)


def _problem(
    hessian: Array,
    gradient: Array,
    lower: ArrayLike,
    upper: ArrayLike,
    rows: ArrayLike | None,
    rows_lower: ArrayLike | None,
    rows_upper: ArrayLike | None,
) -> QP:
    """The problem as one stack of constraints; shapes are checked here."""
    n, dtype = gradient.shape[0], hessian.dtype
    if hessian.shape != (n, n):
        raise ValueError(f"hessian has shape {hessian.shape}, gradient has length {n}")
    if rows is None:
        rows, rows_lower, rows_upper = jnp.zeros((0, n), dtype), jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    if rows_lower is None or rows_upper is None:
        raise ValueError("rows need rows_lower and rows_upper; use -inf or inf for a side without bound")
    stack = [
        jnp.concatenate([jnp.asarray(a, dtype), jnp.asarray(b, dtype)])
        for a, b in ((lower, rows_lower), (upper, rows_upper))
    ]
    rows = jnp.asarray(rows, dtype)
    if stack[0].shape != (n + rows.shape[0],) or stack[1].shape != stack[0].shape:
        raise ValueError(
            f"bounds do not fit: {n} variables, {rows.shape[0]} rows, {stack[0].shape[0]} lower bounds "
            f"and {stack[1].shape[0]} upper bounds"
        )
    return QP(hessian, gradient, rows, *stack)


def _solve(qp: QP, cost_gradient: Gradient, max_iterations: int | None, tolerance: float | None) -> QPSolution:
    n, m = qp.gradient.shape[0], qp.lower.shape[0]
    allowed = jnp.asarray(_VIOLATION[qp.hessian.dtype] if tolerance is None else tolerance, qp.hessian.dtype)
    sane = _finite(qp)
    safe = _replace_where(~sane, qp)
    found = jax.lax.stop_gradient(
        find_active_set(jax.lax.stop_gradient(safe), 10 * m if max_iterations is None else max_iterations, allowed)
    )
    x, y = solve_active_set(safe, found.active, cost_gradient)
    finite = sane & jnp.isfinite(x).all() & jnp.isfinite(y).all()
    x, y = jnp.where(finite, x, 0.0), jnp.where(finite, y, 0.0)
    x = jnp.clip(x, _not_nan(qp.lower[:n], -jnp.inf), _not_nan(qp.upper[:n], jnp.inf))
    slope = jnp.where(finite, cost_gradient(x), 0.0) - safe.rows.T @ y
    multipliers = jnp.where(found.active[:n] != INACTIVE, slope, 0.0)
    everything = jnp.concatenate([multipliers, y])
    residual = _kkt_residual(safe, x, everything, slope - multipliers, found.active)
    return QPSolution(
        x=x,
        status=_status(safe, finite, found, x),
        iterations=found.iterations,
        kkt_residual=residual,
        multipliers=multipliers,
        row_multipliers=y,
        active=found.active,
    )


def _status(qp: QP, finite: Bool[Array, ""], found: ActiveSet, x: Float[Array, " n"]) -> Array:
    """The verdict; a constraint that could not be met counts only where a gap is left, there or in another."""
    values = qp.values(x)
    gap = jnp.maximum(qp.lower - values, values - qp.upper)
    allowed = _FEASIBLE[qp.hessian.dtype] * (1.0 + jnp.abs(values))
    contradicts = (found.impossible.any() & (gap > allowed).any()) | (qp.lower > qp.upper).any()
    verdict = jnp.where(found.settled, jnp.where(contradicts, Status.INFEASIBLE, Status.SOLVED), Status.MAX_ITERATIONS)
    return jnp.where(finite, verdict, Status.NUMERICAL_ERROR)


def _finite(qp: QP) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN anywhere, no infinity but in bounds."""
    data = (qp.hessian, qp.gradient, qp.rows)
    finite = jnp.stack([jnp.isfinite(a).all() for a in data]).all()
    return finite & ~jnp.isnan(qp.lower).any() & ~jnp.isnan(qp.upper).any()


def _replace_where(bad: Bool[Array, ""], qp: QP) -> QP:
    """A harmless problem in the place of a bad one, so that derivatives stay finite too."""
    eye = jnp.eye(qp.hessian.shape[0], dtype=qp.hessian.dtype)
    return QP(
        jnp.where(bad, eye, qp.hessian),
        jnp.where(bad, 0.0, qp.gradient),
        jnp.where(bad, 0.0, qp.rows),
        jnp.where(bad, -jnp.inf, qp.lower),
        jnp.where(bad, jnp.inf, qp.upper),
    )


def _not_nan(bound: Float[Array, " n"], otherwise: float) -> Float[Array, " n"]:
    return jnp.where(jnp.isnan(bound), otherwise, bound)


def _kkt_residual(
    qp: QP, x: Float[Array, " n"], multipliers: Float[Array, " m"], stationarity: Float[Array, " n"], active: Array
) -> Float[Array, ""]:
    """Largest violation of the optimality conditions; multipliers are of the box, then of the rows."""
    values = qp.values(x)
    outside = jnp.maximum(jnp.maximum(qp.lower - values, values - qp.upper), 0.0)
    wrong_sign = jnp.where(active == AT_LOWER, -multipliers, jnp.where(active == AT_UPPER, multipliers, 0.0))
    return jnp.max(jnp.concatenate([jnp.abs(stationarity), outside, wrong_sign]))
