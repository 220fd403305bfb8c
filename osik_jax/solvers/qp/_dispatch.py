"""Choice of backend for a QP: candidates of a kernel, certified, else the search.

The certificate is that of the search (``violated_conditions``, ``kkt_residual``), on the data as they were given, so
that answers do not rest on the kernel; but no gradient has to be smaller than the roundoff of its terms. It costs two
products with the rows. On a GPU the kernel checks the same conditions at its end (``core/qp_certificate.hpp``), where
the rows are at hand. Problems whose candidate fails are gathered into blocks, and the search goes on from the
candidate's active set.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._backends import Backend, on_platforms, takes
from ...execution._candidates import Candidates, certified_or_searched
from ...execution._double import in_double
from ...execution._lanes import FEW_ON_CPU, in_lanes, with_a_few, with_the_rest
from ...numerics._constants import (
    AT_LOWER,
    AT_UPPER,
    EQUALITY,
    GRADIENT_TOL,
    INACTIVE,
    KKT_TOLERANCE,
    SIGN_TOL,
    SINGLE_TOL,
    VALUE_TOL,
)
from ...numerics._dense import apply
from . import _core, _cuda
from ._core import Candidate
from ._cost import LeastSquares
from ._kkt_solve import kkt_inverse
from ._problem import QP, active_bounds, constraint_scales, gradient_scale, kkt_residual, multiplier_roundoff, unpack
from ._search import Roundoff, SearchResult, initial_result, search, usable_guess, violated_conditions

_BLOCKS, _MIN_BLOCK = 16, 1024
"""Block size of the search on a GPU: a 16th of the batch, at least 1,024 problems."""


AsGiven = tuple[QP, Bool[Array, "..."]]
"""Problems before any was replaced because its numbers are not valid, and which are valid."""


@cache
def qp_solver(max_iterations: int, backend: Backend) -> Callable[[QP, AsGiven | None, Array, Array], SearchResult]:
    """Return the function that solves one problem, from its data, a guess of the active set and the tolerance.

    The data may be passed as they were given too: a GPU solves these, so that no copy of them has to be made.
    """
    return in_lanes(partial(_solve_on_platform, max_iterations, backend))


def _solve_on_platform(
    max_iterations: int, backend: Backend, qp: QP, as_given: AsGiven | None, guess: Array, tolerance: Array
) -> SearchResult:
    kernels = {}
    if as_given is not None and takes(backend, "core-cuda", fits=_cuda.fits(qp)):
        kernels["core-cuda"] = cuda_candidates(max_iterations)
    if takes(backend, "core", fits=isinstance(qp.cost, LeastSquares)):
        kernels["core"] = core_candidates(KKT_TOLERANCE[tolerance.dtype], max_iterations)

    def search_all(qp: QP, _: AsGiven | None, guess: Array, tolerance: Array) -> SearchResult:
        return search(qp, guess, tolerance, max_iterations=max_iterations)

    def no_candidates(qp: QP, _: AsGiven | None, guess: Array, tolerance: Array) -> SearchResult:
        return initial_result(qp, guess, tolerance)

    return certified_or_searched(kernels, search_all, qp, as_given, guess, tolerance, no_candidates=no_candidates)


def cuda_candidates(max_iterations: int) -> Candidates:
    """Return the function that uses the core on a GPU in the data's precision, and the search for the rest."""

    def certified(_: QP, as_given: AsGiven, guess: Int[Array, "B m"], tolerance: Float[Array, " B"]) -> SearchResult:
        qp, is_valid = as_given
        if tolerance.dtype == jnp.float32:
            tolerance = jnp.maximum(tolerance, SINGLE_TOL)
        candidate = _cuda.solve(qp, guess, tolerance, max_iterations)
        assert candidate.residual is not None
        # nothing to search where numbers are not valid, and finite numbers for derivatives
        numbers = candidate.x, candidate.row_multipliers, candidate.residual[:, None]
        x, y, residual = (jnp.where(is_valid[:, None], a, 0.0) for a in numbers)
        candidate = candidate._replace(x=x, row_multipliers=y)
        result = _as_result(qp, candidate, residual[:, 0], candidate.converged == _cuda.CERTIFIED)
        return result._replace(done=result.done | ~is_valid)

    def search_rest(
        result: SearchResult, _: QP, as_given: AsGiven, guess: Array, tolerance: Float[Array, " B"]
    ) -> SearchResult:
        qp = as_given[0]

        def search_block(at: Array, result: SearchResult) -> SearchResult:
            block = jax.tree.map(lambda a: a[at], (qp, result.active, tolerance))
            end = search(*block, max_iterations=max_iterations)
            return end._replace(factorizations=end.factorizations + result.factorizations[at])

        return with_the_rest(result, result.done, search_block, _block(len(tolerance)))

    return Candidates(certified, search_rest)


def core_candidates(kkt_tol: float, max_iterations: int) -> Candidates:
    """Return the function that uses the core on a CPU in double precision, and the search for the rest.

    Residuals up to ``kkt_tol`` are certified.
    """

    def certified(qp: QP, _: AsGiven | None, guess: Int[Array, "B m"], tolerance: Float[Array, " B"]) -> SearchResult:
        start = jax.vmap(usable_guess)(qp, guess)
        candidate = _core.solve(qp, start, tolerance, max_iterations)
        return _certified(qp, start, tolerance, candidate, kkt_tol, max_iterations)

    def search_rest(
        result: SearchResult, qp: QP, _: AsGiven | None, guess: Array, tolerance: Float[Array, " B"]
    ) -> SearchResult:
        def search_block(given: tuple[QP | tuple[Array, Array], Array], result: SearchResult) -> SearchResult:
            data, tolerance = given
            like = jax.tree.map(lambda a: a[0], qp)
            block = data if isinstance(data, QP) else jax.vmap(partial(unpack, like))(*data)
            end = search(block, result.active, tolerance, max_iterations=max_iterations)
            return end._replace(factorizations=end.factorizations + result.factorizations)

        # as few arrays as can be: most problems are done
        data = qp if qp.packed is None else (qp.cost.matrix, qp.packed)
        return with_a_few((data, tolerance), result, result.done, search_block, FEW_ON_CPU)

    return Candidates(in_double(certified), search_rest)


def _certified(
    qp: QP, start: Array, tolerance: Float[Array, " B"], candidate: Candidate, kkt_tol: float, max_iterations: int
) -> SearchResult:
    """Return candidates with ``done`` set if certified; ``start`` has their initial labels."""
    residual = jax.vmap(kkt_residual)(qp, candidate.x, candidate.row_multipliers, candidate.active)
    within_limit = candidate.iterations <= max_iterations
    result = _as_result(qp, candidate, residual, (candidate.converged != 0) & within_limit & (residual <= kkt_tol))
    conditions = jax.vmap(_is_certified)(qp, result, tolerance), jax.vmap(_is_stationary)(qp, result)
    is_certified = result.done & jnp.concatenate(conditions, 1).all(1)
    # the search has the limit too: it may not begin where more changes than that have led
    active = jnp.where(within_limit[:, None], result.active, start)
    return result._replace(done=is_certified, optimal=is_certified, active=active)


def _block(batch: int) -> int:
    return min(batch, max(_MIN_BLOCK, -(-batch // _BLOCKS)))


def _as_result(
    qp: QP, candidate: Candidate, residual: Float[Array, " B"], is_certified: Bool[Array, " B"]
) -> SearchResult:
    """Return candidates as search results."""
    zeros, redundant = jnp.zeros_like(candidate.iterations), candidate.redundant
    return SearchResult(
        x=candidate.x,
        row_multipliers=candidate.row_multipliers,
        active=candidate.active,
        redundant=jnp.zeros(candidate.active.shape, bool) if redundant is None else redundant,
        iterations=candidate.iterations,
        factorizations=candidate.factorizations,
        done=is_certified,
        optimal=is_certified,
        infeasible=zeros.astype(bool),
        compliance=qp.compliance,
        residual=residual,
    )


def _is_certified(qp: QP, result: SearchResult, tolerance: Float[Array, ""]) -> Bool[Array, " m"]:
    """Check the optimality conditions of x and y, constraint by constraint.

    Active constraints are at their bounds, the gradient is 0 elsewhere, multipliers have their signs, and inactive
    constraints hold.
    """
    x, y, active = result.x, result.row_multipliers, result.active
    n = len(x)
    is_active = active != INACTIVE
    scales = constraint_scales(qp, qp.cost.diagonal(), x, y)
    # of a robot at rest x itself is roundoff, and so are the scales
    gradient_roundoff = float(jnp.finfo(x.dtype).eps) * gradient_scale(qp, x, y)
    multiplier, smallest = SIGN_TOL * tolerance * scales.multiplier, multiplier_roundoff(qp, x, y)
    in_box, of_rows = jnp.maximum(multiplier[:n], smallest[:n]), GRADIENT_TOL * smallest[n:]
    multiplier = jnp.concatenate([in_box, jnp.minimum(multiplier[n:], of_rows)])
    roundoff = Roundoff(VALUE_TOL * tolerance * scales.value, multiplier)
    gradient = qp.cost.gradient(x) - apply(qp.rows.T, y)
    # an active constraint: x_i = bound, or c'x + compliance y = bound (a soft row is missed by -compliance y)
    off = jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y]) - active_bounds(qp, active)
    # labels that exist, and "equality" where there is one
    valid_label = (jnp.abs(active) == 1) | ~is_active | ((active == EQUALITY) & qp.equality)
    at_bound = jnp.where(is_active, jnp.abs(off) <= roundoff.value, valid_label)
    zero_gradient = jnp.maximum(VALUE_TOL * tolerance * scales.multiplier[:n], GRADIENT_TOL * gradient_roundoff)
    gradient_is_zero = jnp.abs(gradient) <= zero_gradient
    stationary = jnp.where(is_active, valid_label, jnp.concatenate([gradient_is_zero, y == 0.0]))
    valid = jnp.isfinite(jnp.concatenate([x, y])) & at_bound & stationary
    return valid & ~violated_conditions(qp, result, x, y, roundoff)


def _is_stationary(qp: QP, result: SearchResult) -> Bool[Array, " n"]:
    """Check that each variable's gradient is roundoff or points out of its active bound."""
    downhill = apply(qp.rows.T, result.row_multipliers) - qp.cost.gradient(result.x)
    active = result.active[: len(downhill)]
    # a variable at its lower bound may be pulled down but not up, and the other way round
    may_rise, may_fall = (active == INACTIVE) | (active == AT_LOWER), (active == INACTIVE) | (active == AT_UPPER)
    eps = float(jnp.finfo(downhill.dtype).eps)
    roundoff = GRADIENT_TOL * eps * gradient_scale(qp, result.x, result.row_multipliers)
    return (~may_rise | (downhill <= roundoff)) & (~may_fall | (-downhill <= roundoff))


def kkt_solver(qp: QP, active: Int[Array, " m"], backend: Backend) -> Callable[[Array], Array]:
    """Return ``kkt_inverse`` at an active set, computed by the core in single precision on a GPU."""
    if not takes(backend, "core-cuda", fits=qp.lower.dtype == jnp.float32 and _cuda.fits(qp)):
        return kkt_inverse(qp, active)
    return lambda right: _solve_kkt_on_platform()(qp, active, right)


@cache
def _solve_kkt_on_platform() -> Callable[[QP, Array, Array], Array]:
    def plain(qp: QP, active: Array, right: Array) -> Array:
        return kkt_inverse(qp, active)(right)

    return in_lanes(partial(on_platforms, {"core-cuda": _solve_kkt}, jax.vmap(plain)))


def _solve_kkt(qp: QP, active: Int[Array, "B m"], right: Float[Array, "B m"]) -> Float[Array, "B m"]:
    """Solve the KKT system as a QP whose active constraints are equalities and whose others have no bounds."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    n = cost.damping.shape[1]
    free, active_rows = active[:, :n] == INACTIVE, active[:, n:] != INACTIVE
    # the right side of stationarity is the gradient of the damping at x = 0
    center = jnp.where(free, right[:, :n], 0.0) / cost.damping
    bound = jnp.concatenate([jnp.zeros_like(center), -right[:, n:]], 1)
    is_equality = jnp.concatenate([~free, active_rows], 1)
    system = replace(
        qp,
        cost=replace(cost, target=jnp.zeros_like(cost.target), center=center),
        lower=jnp.where(is_equality, bound, -jnp.inf),
        upper=jnp.where(is_equality, bound, jnp.inf),
    )
    tolerance = jnp.full(active.shape[0], SINGLE_TOL, center.dtype)
    candidate = _cuda.solve(system, jnp.where(is_equality, EQUALITY, INACTIVE), tolerance, 0)
    point = jnp.concatenate([candidate.x, jnp.where(active_rows, candidate.row_multipliers, 0.0)], 1)
    done = (candidate.converged != 0) & jnp.isfinite(point).all(1)

    def solve_block(at: Array, point: Array) -> Array:
        block = jax.tree.map(lambda a: a[at], (qp, active, right))
        return jax.vmap(lambda qp, active, right: kkt_inverse(qp, active)(right))(*block)

    return with_the_rest(point, done, solve_block, _block(len(active)))
