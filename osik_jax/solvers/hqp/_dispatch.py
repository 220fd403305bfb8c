"""Choice of backend for a hierarchy: candidates of a kernel, certified in plain JAX, else the search.

A kernel judges each level as ``solve_on_working_set`` does, by feasibility and multipliers. What is certified here is
what needs no factorisation: numbers are finite, x is in its box, and no level lost its optimum to those below. Problems
whose candidate fails are gathered into blocks and solved level after level by the search.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...execution._backends import Backend, takes
from ...execution._candidates import Candidates, certified_or_searched
from ...execution._double import in_double
from ...execution._lanes import in_lanes, with_the_rest
from ...numerics._constants import BOX_TOLERANCE
from . import _core
from ._cascade import CascadeResult, certify_levels, solve_cascade
from ._problem import Layout, PaddedHierarchy, Tolerances, WorkingSet

_BLOCK = 256
"""Number of problems that the search solves together; on a GPU its many small operations cost the same for one."""


Solve = Callable[[Layout, PaddedHierarchy, Tolerances, WorkingSet | None, int], CascadeResult]


@cache
def hierarchy_solver(
    layout: Layout, max_iterations: int | None, backend: Backend
) -> Callable[[PaddedHierarchy, Tolerances, WorkingSet | None], CascadeResult]:
    """Return the function that solves all levels of one problem, in double precision.

    ``max_iterations`` limits the active-set iterations of one level; None for 10 (n + rows of the longest level).
    """
    limit = 10 * (layout.variables + layout.rows) if max_iterations is None else max_iterations
    return in_lanes(in_double(partial(_solve_on_platform, layout, limit, backend)))


def _solve_on_platform(
    layout: Layout,
    max_iterations: int,
    backend: Backend,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
) -> CascadeResult:
    kernels = {}
    if takes(backend, "core-cuda", fits=_core.fits(layout)):
        kernels["core-cuda"] = kernel_candidates(layout, max_iterations, _core.solve_on_gpu)
    if takes(backend, "core", fits=True):
        kernels["core"] = kernel_candidates(layout, max_iterations, _core.solve)

    def search(hierarchy: PaddedHierarchy, tolerances: Tolerances, _: WorkingSet | None) -> CascadeResult:
        return solve_cascade(layout, max_iterations, hierarchy, tolerances)

    return certified_or_searched(kernels, search, hierarchy, tolerances, warm_start)


def kernel_candidates(layout: Layout, max_iterations: int, solve: Solve) -> Candidates:
    """Return the function that uses a kernel: certified candidates, and the search in blocks for other problems."""

    def certified(hierarchy: PaddedHierarchy, tolerances: Tolerances, warm_start: WorkingSet | None) -> CascadeResult:
        candidates = solve(layout, hierarchy, tolerances, warm_start, max_iterations)
        valid = jax.vmap(_is_valid)(candidates, hierarchy, tolerances)
        answers = candidates._replace(x=jax.vmap(_inside_box)(candidates.x, hierarchy))
        result = jax.vmap(certify_levels)(answers, hierarchy, tolerances)
        return result._replace(done=result.done & valid)

    def search_rest(
        result: CascadeResult, hierarchy: PaddedHierarchy, tolerances: Tolerances, warm_start: WorkingSet | None
    ) -> CascadeResult:
        def search_block(at: Array, result: CascadeResult) -> CascadeResult:
            block, block_tolerances = jax.tree.map(lambda a: a[at], (hierarchy, tolerances))
            return solve_cascade(layout, max_iterations, block, block_tolerances)

        return with_the_rest(result, result.done, search_block, min(_BLOCK, len(result.done)))

    return Candidates(certified, search_rest)


def _inside_box(x: Float[Array, " n"], hierarchy: PaddedHierarchy) -> Float[Array, " n"]:
    """Return x clipped into its box."""
    return jnp.clip(x, hierarchy.hard_lower[: len(x)], hierarchy.hard_upper[: len(x)])


def _is_valid(result: CascadeResult, hierarchy: PaddedHierarchy, tolerances: Tolerances) -> Bool[Array, ""]:
    """Check that the numbers are finite and that x is inside its box, up to roundoff."""
    x = result.x
    inside = jnp.abs(x - _inside_box(x, hierarchy)) <= BOX_TOLERANCE * tolerances.rank * jnp.max(jnp.abs(x))
    valid = jnp.isfinite(x) & inside
    return valid.all() & jnp.isfinite(result.residual) & jnp.isfinite(result.multipliers).all()
