"""Choice of backend for a QP: candidates of a kernel, certified, else the search.

The kernel checks the optimality conditions at its end (``core/qp_certificate.hpp``), where the rows are at hand.
Problems whose candidate fails are gathered into blocks, given to the kernel in double precision if it was in single,
and the search goes on from the active set of the last candidate.
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
from ...numerics._constants import EQUALITY, INACTIVE, SINGLE_TOL
from . import _core
from ._core import CERTIFIED, LEAST_VIOLATION, Candidate
from ._kkt_solve import kkt_inverse
from ._problem import QP, LeastSquares, compliance_of
from ._search import SearchResult, search

_BLOCKS, _MIN_BLOCK = 16, 1024
"""Block size of the search on a GPU: a 16th of the batch, at least 1,024 problems."""


AsGiven = tuple[QP, Bool[Array, "..."]]
"""Problems before any was replaced because its numbers are not valid, and which are valid."""


@cache
def qp_solver(max_iterations: int, backend: Backend) -> Callable[[QP, AsGiven, Array, Array], SearchResult]:
    """Return the function that solves one problem, from its data, a guess of the active set and the tolerance.

    The data are passed as they were given too: kernels solve these, so that no copy of them has to be made.
    """
    return in_lanes(partial(_solve_on_platform, max_iterations, backend))


def _solve_on_platform(
    max_iterations: int, backend: Backend, qp: QP, as_given: AsGiven, guess: Array, tolerance: Array
) -> SearchResult:
    kernels = {}
    if takes(backend, "core-cuda", fits=_core.fits(qp)):
        twice = qp.lower.dtype == jnp.float32 and _core.fits(qp, single=False)
        kernels["core-cuda"] = kernel_candidates(max_iterations, _core.solve_on_gpu, twice=twice)
    if takes(backend, "core", fits=isinstance(qp.cost, LeastSquares)):
        kernels["core"] = kernel_candidates(max_iterations, _core.solve, FEW_ON_CPU)

    def search_all(qp: QP, _: AsGiven, guess: Array, tolerance: Array) -> SearchResult:
        return search(qp, guess, tolerance, max_iterations=max_iterations)

    return certified_or_searched(kernels, search_all, qp, as_given, guess, tolerance)


def kernel_candidates(
    max_iterations: int, solve: Callable[..., Candidate], block: int | None = None, *, twice: bool = False
) -> Candidates:
    """Return the function that uses a kernel, which certifies its candidates, and the search for the rest.

    Args:
        max_iterations: limit on the changes of the active set.
        solve: the kernel.
        block: how many problems are searched together; by default as on a GPU.
        twice: whether problems whose candidate fails are given to the kernel again, in double precision.
    """
    by_kernel = partial(_certified, solve, max_iterations)

    def search_rest(
        result: SearchResult, _: QP, as_given: AsGiven, guess: Array, tolerance: Float[Array, " B"]
    ) -> SearchResult:
        def again(data: tuple[QP, Array], result: SearchResult) -> SearchResult:
            valid = jnp.ones(len(data[1]), bool)
            return added(in_double(by_kernel)(data[0], (data[0], valid), result.active, data[1]), result)

        def search_block(data: tuple[QP, Array], result: SearchResult) -> SearchResult:
            return added(search(data[0], result.active, data[1], max_iterations=max_iterations), result)

        def added(end: SearchResult, before: SearchResult) -> SearchResult:
            return end._replace(factorizations=end.factorizations + before.factorizations)

        data, size = (as_given[0], tolerance), block or _block(len(tolerance))
        if twice:
            result = with_a_few(data, result, result.done, again, size)
        return with_a_few(data, result, result.done, search_block, size)

    return Candidates(by_kernel, search_rest)


def _certified(
    solve: Callable[..., Candidate],
    max_iterations: int,
    _: QP,
    as_given: AsGiven,
    guess: Int[Array, "B m"],
    tolerance: Float[Array, " B"],
) -> SearchResult:
    """Return what a kernel finds, done where it is certified or nothing is to be found."""
    qp, is_valid = as_given
    candidate = solve(qp, guess, tolerance, max_iterations)
    within_limit = candidate.iterations <= max_iterations
    certified = (candidate.converged == CERTIFIED) & within_limit & is_valid
    infeasible = (candidate.converged == LEAST_VIOLATION) & is_valid
    # nothing to search where numbers are not valid, and finite numbers for derivatives
    numbers = candidate.x, candidate.row_multipliers, candidate.residual[:, None]
    x, y, residual = (jnp.where(is_valid[:, None], a, 0.0) for a in numbers)
    return SearchResult(
        x=x,
        row_multipliers=y,
        # the search has the limit too: it may not begin where more changes than that have led
        active=jnp.where((within_limit | infeasible)[:, None], candidate.active, guess),
        iterations=candidate.iterations,
        factorizations=candidate.factorizations,
        done=certified | infeasible | ~is_valid,
        optimal=certified,
        infeasible=infeasible,
        compliance=jnp.where(infeasible[:, None], jax.vmap(compliance_of)(qp, x, y), qp.compliance),
        residual=residual[:, 0],
    )


def _block(batch: int) -> int:
    return min(batch, max(_MIN_BLOCK, -(-batch // _BLOCKS)))


def kkt_solver(qp: QP, active: Int[Array, " m"], backend: Backend) -> Callable[[Array], Array]:
    """Return ``kkt_inverse`` at an active set, computed by the core in single precision on a GPU."""
    if not takes(backend, "core-cuda", fits=qp.lower.dtype == jnp.float32 and _core.fits(qp)):
        return kkt_inverse(qp, active)
    return lambda right: _solve_kkt_on_platform()(qp, active, right)


@cache
def _solve_kkt_on_platform() -> Callable[[QP, Array, Array], Array]:
    return in_lanes(partial(on_platforms, {"core-cuda": _solve_kkt}, _solve_kkt_in_jax))


@jax.vmap
def _solve_kkt_in_jax(qp: QP, active: Int[Array, " m"], right: Float[Array, " m"]) -> Float[Array, " m"]:
    return kkt_inverse(qp, active)(right)


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
    candidate = _core.solve_on_gpu(system, jnp.where(is_equality, EQUALITY, INACTIVE), tolerance, 0)
    point = jnp.concatenate([candidate.x, jnp.where(active_rows, candidate.row_multipliers, 0.0)], 1)
    done = (candidate.converged != 0) & jnp.isfinite(point).all(1)

    def solve_block(at: Array, point: Array) -> Array:
        return _solve_kkt_in_jax(*jax.tree.map(lambda a: a[at], (qp, active, right)))

    return with_the_rest(point, done, solve_block, _block(len(active)))
