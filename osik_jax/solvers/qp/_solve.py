"""solve_qp and solve_least_squares_qp: find the active set, solve exactly on it, certify."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ... import _rules
from ..._errors import OsikValueError
from .._backends import Backend, check_backend, here
from .._box import inside, uncrossed
from .._dense import apply
from .._pivots import INACTIVE
from .._status import Status
from ._cost import LeastSquares, Quadratic
from ._derivative import differentiable
from ._fused import searcher
from ._problem import QP, QPSolution
from ._search import Found

_TOLERANCE = 1e-12


@partial(jax.jit, static_argnames=("max_iterations", "backend"))
def solve_qp(
    hessian: Float[ArrayLike, "n n"],
    gradient: Float[ArrayLike, " n"],
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
    """Minimises 1/2 x'Hx + g'x  subject to  lower <= x <= upper,  rows_lower <= rows x <= rows_upper.

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
        rows_compliance: 0 (the default) for a hard row; a row of compliance c > 0 gives way by t at a cost of
            t^2 / (2 c). (p,)
        warm_start: ``active`` of the solution of a problem nearby. It changes the time, not the answer. (n + p,)
        max_iterations: cap on changes of the active set (static); default 20 (n + p).
        tolerance: violation that counts as none, relative to the scale of the constraint; default 1e-12.
        backend: "auto" or "jax" (static): there is no kernel for this form.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.
    """
    hessian, gradient = jnp.asarray(hessian), jnp.asarray(gradient)
    n = gradient.shape[0]
    if hessian.shape != (n, n):
        raise OsikValueError(f"hessian has shape {hessian.shape}, gradient has length {n}")
    qp = _problem(Quadratic(hessian, gradient), n, lower, upper, rows, rows_lower, rows_upper, rows_compliance)
    return _solve(qp, warm_start, max_iterations, tolerance, backend)


@partial(jax.jit, static_argnames=("max_iterations", "rows_equalities", "backend"))
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
    center: Float[ArrayLike, "..."] = 0.0,
    rows_compliance: Float[ArrayLike, " p"] | None = None,
    rows_equalities: tuple[bool, ...] | None = None,
    warm_start: Int[ArrayLike, " n_and_p"] | None = None,
    max_iterations: int | None = None,
    tolerance: Float[ArrayLike, ""] | None = None,
    backend: Backend = "auto",
) -> QPSolution:
    """Minimises 1/2 sum_i weight_i (matrix_i x - target_i)^2 + 1/2 damping |x - center|^2, constrained as ``solve_qp``.

    The factored form: the answer is refined against residuals of the matrix itself, so that small weights survive
    beside large ones.

    Args:
        matrix: A. (m, n)
        target: b. (m,)
        weight: of the squared residuals, >= 0. (m,)
        damping: > 0; makes the answer unique. A scalar or one per variable (n,).
        center: where the damping pulls to. A scalar or one per variable (n,).
        lower: as in ``solve_qp``, and so are the following.
        upper: of the box. (n,)
        rows: general constraints. (p, n)
        rows_lower: of the rows. (p,)
        rows_upper: of the rows. (p,)
        rows_compliance: of the rows; 0 where hard. (p,)
        rows_equalities: rows that are equalities whatever ``rows_upper`` says, which is not looked at there (static).
            Name them where bounds are computed under ``jit``: XLA may compute an expression twice, in two roundings,
            and what was one number is then two. (p,)
        warm_start: ``active`` of the solution of a problem nearby. (n + p,)
        max_iterations: cap on changes of the active set (static).
        tolerance: relative violation that counts as none.
        backend: whose candidates for the answer are taken (static): "auto" for those of the kernels that are there for
            the platform, "jax" for none, "numba" (CPUs) or "warp" (CUDA) for that or an error. It changes the time,
            not the answer.
    """
    matrix, target, weight = jnp.asarray(matrix), jnp.asarray(target), jnp.asarray(weight)
    n = matrix.shape[1]
    pulls = (jnp.broadcast_to(jnp.asarray(number, matrix.dtype), (n,)) for number in (damping, center))
    cost = LeastSquares(matrix, target, weight, *pulls)
    qp = _problem(cost, n, lower, upper, rows, rows_lower, rows_upper, rows_compliance, rows_equalities)
    gives_way = rows is None or (rows_compliance is not None and not any(rows_equalities or ()))
    return _solve(qp, warm_start, max_iterations, tolerance, backend, gives_way=gives_way)


def _problem(
    cost: Quadratic | LeastSquares,
    n: int,
    lower: ArrayLike,
    upper: ArrayLike,
    rows: ArrayLike | None,
    rows_lower: ArrayLike | None,
    rows_upper: ArrayLike | None,
    compliance: ArrayLike | None,
    equalities: tuple[bool, ...] | None = None,
) -> QP:
    """The problem as one stack of constraints; shapes are checked here."""
    dtype = cost.matrix.dtype
    if rows is None:
        rows, rows_lower, rows_upper = jnp.zeros((0, n), dtype), jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    if rows_lower is None or rows_upper is None:
        raise OsikValueError("rows need rows_lower and rows_upper; use -inf or inf for a side without bound")
    stack = [
        jnp.concatenate([jnp.asarray(a, dtype), jnp.asarray(b, dtype)])
        for a, b in ((lower, rows_lower), (upper, rows_upper))
    ]
    rows = jnp.asarray(rows, dtype)
    p = rows.shape[0]
    if stack[0].shape != (n + p,) or stack[1].shape != stack[0].shape:
        raise OsikValueError(
            f"bounds do not fit: {n} variables, {p} rows, {stack[0].shape[0]} lower bounds "
            f"and {stack[1].shape[0]} upper bounds"
        )
    compliance = jnp.zeros(p, dtype) if compliance is None else jnp.asarray(compliance, dtype)
    if compliance.shape != (p,):
        raise OsikValueError(f"rows_compliance has shape {compliance.shape}; there are {p} rows")
    equalities = (False,) * p if equalities is None else equalities
    if len(equalities) != p:
        raise OsikValueError(f"rows_equalities has {len(equalities)} flags; there are {p} rows")
    known = (False,) * n + equalities if any(equalities) else None
    return QP(cost, rows, compliance, stack[0], stack[1], known)


def _solve(
    qp: QP,
    guess: ArrayLike | None,
    max_iterations: int | None,
    tolerance: ArrayLike | None,
    backend: Backend,
    *,
    gives_way: bool = False,
) -> QPSolution:
    """Searches, certifies, and differentiates nothing but the answer; ``gives_way`` where rows may all be soft."""
    m, p = qp.lower.shape[0], qp.rows.shape[0]
    n, dtype = m - p, qp.lower.dtype
    allowed = jnp.asarray(_TOLERANCE if tolerance is None else tolerance, dtype)
    sane = _finite(qp)
    safe = _replace_where(~sane, qp)
    low, high, crossed = uncrossed(safe.lower, _upper(safe))
    safe = replace(safe, lower=low, upper=high)
    cold = jnp.zeros(m, jnp.int32) if guess is None else jnp.asarray(guess)
    search = searcher(20 * m if max_iterations is None else max_iterations, gives_way, here(check_backend(backend)))
    found = _rules.found(search(*jax.lax.stop_gradient((safe, cold, allowed))))
    solved = replace(safe, compliance=jnp.where(found.infeasible, found.compliance, safe.compliance))
    answered = found.optimal | found.infeasible
    moving = differentiable(backend)(found.x, found.row_multipliers, found.active, solved)
    x, y = (jnp.where(answered, a, b) for a, b in zip(moving, (found.x, found.row_multipliers), strict=True))
    finite = sane & jnp.isfinite(x).all() & jnp.isfinite(y).all()
    x, y = jnp.where(finite, x, 0.0), jnp.where(finite, y, 0.0)
    x = inside(x, *(jnp.where(sane, b, raw)[:n] for b, raw in ((safe.lower, qp.lower), (safe.upper, qp.upper))))
    slope = jnp.where(finite, safe.cost.gradient(x), 0.0) - apply(safe.rows.T, y)
    multipliers = jnp.where(found.active[:n] != INACTIVE, slope, 0.0)
    value = apply(safe.rows, x)
    return QPSolution(
        x=x,
        status=_status(finite, crossed, found),
        iterations=found.iterations,
        factorizations=found.factorizations,
        kkt_residual=found.residual,
        slack=value - jnp.clip(value, safe.lower[n:], safe.upper[n:]),
        multipliers=multipliers,
        row_multipliers=y,
        active=found.active,
    )


def _upper(qp: QP) -> Float[Array, " n_and_p"]:
    """Upper bounds, those of known equalities exactly the lower ones."""
    return qp.upper if qp.known is None else jnp.where(np.array(qp.known), qp.lower, qp.upper)


def _status(finite: Bool[Array, ""], crossed: Bool[Array, ""], found: Found) -> Array:
    verdict = jnp.where(found.optimal, Status.SOLVED, Status.MAX_ITERATIONS)
    verdict = jnp.where(found.infeasible | crossed, Status.INFEASIBLE, verdict)
    return jnp.where(finite, verdict, Status.NUMERICAL_ERROR)


def _finite(qp: QP) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN anywhere, no infinity but as no bound, no negative weight."""
    data = jax.tree.leaves((qp.cost, qp.rows, qp.compliance))
    finite = jnp.stack([jnp.isfinite(a).all() for a in data]).all() & ~qp.cost.bends_down()
    return finite & jnp.all(qp.lower < jnp.inf) & jnp.all(qp.upper > -jnp.inf)


def _replace_where(bad: Bool[Array, ""], qp: QP) -> QP:
    """A harmless problem in the place of a bad one, so that derivatives stay finite too."""
    free = jnp.full_like(qp.upper, jnp.inf)
    if qp.known is not None:
        free = jnp.where(np.array(qp.known), 0.0, free)
    harmless = QP(qp.cost.harmless(), jnp.zeros_like(qp.rows), jnp.ones_like(qp.compliance), -free, free, qp.known)
    return jax.tree.map(lambda a, b: jnp.where(bad, a, b), harmless, qp)
