"""Entry points of QPs: check the data, solve, attach the derivative, set the status."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from ..._errors import OsikValueError
from ...execution import _rules
from ...execution._backends import Backend, check_backend
from ...numerics._arguments import as_floats
from ...numerics._constants import FEASIBILITY, INACTIVE
from ...numerics._dense import apply
from .._box import clip_roundoff, ordered_bounds
from .._level import bounds_exist
from .._status import Status
from ._dispatch import qp_solver
from ._implicit_diff import with_derivative
from ._problem import QP, LeastSquares, QPSolution, Quadratic
from ._search import SearchResult


@partial(jax.jit, static_argnames=("max_iterations", "backend"))
def solve_qp(
    hessian: Num[ArrayLike, "n n"],
    gradient: Num[ArrayLike, " n"],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    rows: Float[ArrayLike, "p n"] | None = None,
    rows_lower: Float[ArrayLike, " p"] | None = None,
    rows_upper: Float[ArrayLike, " p"] | None = None,
    *,
    rows_compliance: Float[ArrayLike, " p"] | None = None,
    warm_start: Int[ArrayLike, " n_and_p"] | None = None,
    max_iterations: int | None = None,
    tolerance: Float[ArrayLike, ""] | None = None,
    backend: Backend = "auto",
) -> QPSolution:
    """Minimise 1/2 x'Hx + g'x  subject to  lower <= x <= upper,  rows_lower <= rows x <= rows_upper.

    Pure, compiled on first use, and batched by ``vmap``. Derivatives with respect to every array, in both modes and to
    any order, are those of the solution map at its active set.

    Args:
        hessian: H, symmetric positive definite. (n, n)
        gradient: g. (n,)
        lower: -inf where unbounded; equal to ``upper`` pins x. (n,)
        upper: inf where unbounded. (n,)
        rows: general constraints. (p, n)
        rows_lower: lower bounds of the rows; equal bounds make an equality. (p,)
        rows_upper: upper bounds of the rows. (p,)
        rows_compliance: 0 (the default) for a hard row; a row of compliance c > 0 may be missed by t at a cost of
            t^2 / (2 c). (p,)
        warm_start: ``active`` of the solution of a problem nearby. It changes the time, not the answer. (n + p,)
        max_iterations: limit on the changes of the active set (static); default 20 (n + p).
        tolerance: violation that counts as none, relative to the scale of the constraint; default 1e-12.
        backend: "auto" or "jax" (static): there is no kernel for this form.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.
    """
    hessian, gradient = as_floats(hessian, gradient), as_floats(gradient, hessian)
    n = gradient.shape[0]
    if hessian.shape != (n, n):
        raise OsikValueError(f"hessian has shape {hessian.shape}, gradient has length {n}")
    qp = _problem(Quadratic(hessian, gradient), lower, upper, rows, rows_lower, rows_upper, rows_compliance)
    return _solve(qp, warm_start, max_iterations, tolerance, backend)


@partial(jax.jit, static_argnames=("max_iterations", "rows_equalities", "backend"))
def solve_least_squares_qp(
    matrix: Num[ArrayLike, "m n"],
    target: Num[ArrayLike, " m"],
    weight: Num[ArrayLike, " m"],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    rows: Float[ArrayLike, "p n"] | None = None,
    rows_lower: Float[ArrayLike, " p"] | None = None,
    rows_upper: Float[ArrayLike, " p"] | None = None,
    *,
    damping: Float[ArrayLike, "..."] = 1e-9,
    center: Float[ArrayLike, "..."] = 0.0,
    rows_compliance: Float[ArrayLike, " p"] | None = None,
    rows_equalities: tuple[bool, ...] | None = None,
    warm_start: Int[ArrayLike, " n_and_p"] | None = None,
    max_iterations: int | None = None,
    tolerance: Float[ArrayLike, ""] | None = None,
    backend: Backend = "auto",
) -> QPSolution:
    """Minimise 1/2 sum_i weight_i (matrix_i x - target_i)^2 + 1/2 damping |x - center|^2, constrained as ``solve_qp``.

    The factored form: the answer is refined against residuals of the matrix itself, so that small weights survive
    beside large ones.

    Args:
        matrix: A. (m, n)
        target: b. (m,)
        weight: of the squared residuals, >= 0. (m,)
        damping: > 0; makes the answer unique. A scalar or one per variable (n,).
        center: the point that the damping draws x to. A scalar or one per variable (n,).
        lower: as in ``solve_qp``, and so are the following.
        upper: of the box. (n,)
        rows: general constraints. (p, n)
        rows_lower: of the rows. (p,)
        rows_upper: of the rows. (p,)
        rows_compliance: of the rows; 0 where hard. (p,)
        rows_equalities: rows that are equalities whatever ``rows_upper`` says, which is not looked at there (static).
            Name them where bounds are computed under ``jit``: XLA may compute an expression twice and round it in
            two ways: what was one number is then two. (p,)
        warm_start: ``active`` of the solution of a problem nearby. (n + p,)
        max_iterations: limit on the changes of the active set (static).
        tolerance: relative violation that counts as none.
        backend: whose candidates for the answer are taken (static): "auto" for those of the kernels that are there for
            the platform, "jax" for none, "core" for that or an error. It changes the time, not the answer.
    """
    matrix = as_floats(matrix, target, weight)
    target, weight = as_floats(target, matrix), as_floats(weight, matrix)
    n = matrix.shape[1]
    diagonal = (jnp.broadcast_to(jnp.asarray(number, matrix.dtype), (n,)) for number in (damping, center))
    cost = LeastSquares(matrix, target, weight, *diagonal)
    qp = _problem(cost, lower, upper, rows, rows_lower, rows_upper, rows_compliance, rows_equalities)
    return _solve(qp, warm_start, max_iterations, tolerance, backend)


def _problem(
    cost: Quadratic | LeastSquares,
    lower: ArrayLike,
    upper: ArrayLike,
    rows: ArrayLike | None,
    rows_lower: ArrayLike | None,
    rows_upper: ArrayLike | None,
    compliance: ArrayLike | None,
    equalities: tuple[bool, ...] | None = None,
) -> QP:
    """Return the problem with the bounds of box and rows concatenated, after checking shapes."""
    dtype, n = cost.matrix.dtype, cost.matrix.shape[1]
    if rows is None:
        rows, rows_lower, rows_upper = jnp.zeros((0, n), dtype), jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    if rows_lower is None or rows_upper is None:
        raise OsikValueError("rows need rows_lower and rows_upper; use -inf or inf for a side without bound")
    bounds = [
        jnp.concatenate([jnp.asarray(a, dtype), jnp.asarray(b, dtype)])
        for a, b in ((lower, rows_lower), (upper, rows_upper))
    ]
    rows = jnp.asarray(rows, dtype)
    p = rows.shape[0]
    if bounds[0].shape != (n + p,) or bounds[1].shape != bounds[0].shape:
        raise OsikValueError(
            f"bounds do not fit: {n} variables, {p} rows, {bounds[0].shape[0]} lower bounds "
            f"and {bounds[1].shape[0]} upper bounds"
        )
    compliance = jnp.zeros(p, dtype) if compliance is None else jnp.asarray(compliance, dtype)
    if compliance.shape != (p,):
        raise OsikValueError(f"rows_compliance has shape {compliance.shape}; there are {p} rows")
    equalities = (False,) * p if equalities is None else equalities
    if len(equalities) != p:
        raise OsikValueError(f"rows_equalities has {len(equalities)} flags; there are {p} rows")
    known = (False,) * n + equalities if any(equalities) else None
    return QP(cost, rows, compliance, bounds[0], bounds[1], known)


def _solve(
    qp: QP,
    guess: ArrayLike | None,
    max_iterations: int | None,
    tolerance: ArrayLike | None,
    backend: Backend,
) -> QPSolution:
    """Solve, certify and attach the derivative."""
    m, p = qp.lower.shape[0], qp.rows.shape[0]
    n, dtype = m - p, qp.lower.dtype
    tolerance = jnp.asarray(FEASIBILITY if tolerance is None else tolerance, dtype)
    # bounds with lower > upper become equalities halfway; the status says so
    low, high, unordered = ordered_bounds(qp.lower, _upper(qp))
    # NaN and negative weights are replaced before the first operation, so that derivatives stay finite
    given = replace(qp, lower=low, upper=high)
    safe, is_valid = _with_placeholder(given)
    start = jnp.zeros(m, jnp.int32) if guess is None else jnp.asarray(guess)
    limit = 20 * m if max_iterations is None else max_iterations
    solve = qp_solver(limit, check_backend(backend))
    # the search is not differentiated: its answer is, at the active set that was found
    result = _rules.found(solve(*jax.lax.stop_gradient((safe, (given, is_valid), start, tolerance))))
    x, y, is_finite = _differentiable(safe, result, is_valid, backend)
    # at the end x is inside the box that was given, to the last bit
    box = (jnp.where(is_valid, b, own)[:n] for b, own in ((safe.lower, qp.lower), (safe.upper, qp.upper)))
    x = clip_roundoff(x, *box)
    # multipliers of the box from stationarity: grad cost - C'y at active variables, 0 at free ones
    gradient = jnp.where(is_finite, safe.cost.gradient(x), 0.0) - apply(safe.rows.T, y)
    multipliers = jnp.where(result.active[:n] != INACTIVE, gradient, 0.0)
    value = apply(safe.rows, x)
    return QPSolution(
        x=x,
        status=_status(is_finite, unordered, result),
        iterations=result.iterations,
        factorizations=result.factorizations,
        kkt_residual=result.residual,
        slack=value - jnp.clip(value, safe.lower[n:], safe.upper[n:]),
        multipliers=multipliers,
        row_multipliers=y,
        active=result.active,
    )


def _differentiable(
    safe: QP, result: SearchResult, is_valid: Bool[Array, ""], backend: Backend
) -> tuple[Float[Array, " n"], Float[Array, " p"], Bool[Array, ""]]:
    """Return x and the row multipliers with their derivatives (0 if not finite), and whether they are finite.

    The derivative is that of the problem which x solves: with infeasible hard rows, the softened one.
    """
    compliance = jnp.where(result.infeasible, result.compliance, safe.compliance)
    solved = replace(safe, compliance=compliance)
    has_answer = result.optimal | result.infeasible
    constant = result.x, result.row_multipliers
    differentiable = with_derivative(backend)(*constant, result.active, solved)
    x, y = (jnp.where(has_answer, a, b) for a, b in zip(differentiable, constant, strict=True))
    is_finite = is_valid & jnp.isfinite(x).all() & jnp.isfinite(y).all()
    return jnp.where(is_finite, x, 0.0), jnp.where(is_finite, y, 0.0), is_finite


def _upper(qp: QP) -> Float[Array, " n_and_p"]:
    """Return the upper bounds; for known equalities they equal the lower bounds."""
    if qp.known_equalities is None:
        return qp.upper
    return jnp.where(np.array(qp.known_equalities), qp.lower, qp.upper)


def _status(is_finite: Bool[Array, ""], unordered: Bool[Array, ""], result: SearchResult) -> Array:
    status = jnp.where(result.optimal, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(result.infeasible | unordered, Status.INFEASIBLE, status)
    return jnp.where(is_finite, status, Status.NUMERICAL_ERROR)


def _with_placeholder(qp: QP) -> tuple[QP, Bool[Array, ""]]:
    """Return the problem, or a placeholder if its numbers are not valid, and whether they are.

    Valid are numbers without NaN, infinities only as bounds that do not exist, and weights that are not negative. The
    placeholder keeps derivatives finite too.
    """
    unbounded = jnp.full_like(qp.upper, jnp.inf)
    if qp.known_equalities is not None:
        unbounded = jnp.where(np.array(qp.known_equalities), 0.0, unbounded)
    placeholder = QP(
        cost=qp.cost.placeholder(),
        rows=jnp.zeros_like(qp.rows),
        compliance=jnp.ones_like(qp.compliance),
        lower=-unbounded,
        upper=unbounded,
        known_equalities=qp.known_equalities,
    )
    finite = [jnp.isfinite(a).all() for a in jax.tree.leaves((qp.cost, qp.rows, qp.compliance))]
    is_valid = jnp.stack([*finite, qp.cost.has_valid_signs(), bounds_exist(qp.lower, qp.upper)]).all()
    return jax.tree.map(lambda a, b: jnp.where(is_valid, a, b), qp, placeholder), is_valid
