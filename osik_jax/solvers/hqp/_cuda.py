"""Candidates for hierarchies on a GPU (``core/hierarchy.hpp``), one warp of 32 threads per problem."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax.numpy as jnp

from ...core import _cuda, _library
from ._cascade import CascadeResult, KernelAnswers, first_working_sets, result_of_kernel
from ._padding import Layout, PaddedHierarchy
from ._problem import Tolerances, WorkingSet

_MAX_ROWS = 64  # the triangular solves of a warp hold two entries a thread
_KERNEL = """
using namespace osik;
using Method = Hierarchy<Warp<double, N, M, H>>;
extern "C" __global__ void __launch_bounds__(32) osik_kernel(
    const double* matrix, const double* lower, const double* upper, const double* hard, const double* hard_lower,
    const double* hard_upper, const double* damping, const double* bends, const double* tolerances,
    const int* equality, const int* pinned, const int* guess_hard, const int* guess_own,
    double* x, double* multipliers, double* slack_norms, double* dampings, double* residual,
    int* active_bounds, int* active, int* frozen, int* in_cost, int* own, int* ranks, int* report, int problems) {
  const int k = blockIdx.x;
  const Sizes s{L, M, N, H, MAX_ITERATIONS, ROW_COUNTS, LEVEL_OF_HARD, ROW_OF_HARD};
  Problem p{matrix, lower, upper, hard, hard_lower, hard_upper, damping, bends, tolerances,
            equality, pinned, guess_hard, guess_own, 1, ROWS, true};
  Answer a{x, multipliers, slack_norms, dampings, residual, active_bounds, active, frozen, in_cost, own, ranks, report};
  advance(p, s, k);
  advance(a, s, k);
  Method method(s, nullptr);
  method.solve(p, a);
}
"""


@cache
def _bytes(layout: Layout) -> int:
    """Return the shared memory of one problem, a multiple of 16."""
    library = _library.core().library
    if library is None:
        return _cuda.SHARED_BYTES + 1
    return library.osik_hierarchy_bytes(layout.levels, layout.rows, layout.variables, len(layout.level_of_hard))


def fits(layout: Layout) -> bool:
    """Return whether a GPU has room for a problem."""
    return _cuda.installed() and layout.rows <= _MAX_ROWS and _bytes(layout) <= _cuda.SHARED_BYTES


@cache
def _source(layout: Layout, max_iterations: int) -> str:
    n, h = layout.variables, len(layout.level_of_hard)
    numbers = dict(N=n, M=layout.rows, H=h, L=layout.levels, ROWS=sum(layout.row_counts))
    numbers |= dict(MAX_ITERATIONS=max_iterations)
    lists = dict(ROW_COUNTS=layout.row_counts, LEVEL_OF_HARD=layout.level_of_hard, ROW_OF_HARD=layout.row_of_hard)
    return _cuda.text_of("hierarchy.hpp") + _cuda.constants(**numbers, **lists) + _KERNEL


def solve(
    layout: Layout,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
    max_iterations: int,
) -> CascadeResult:
    """Return candidates for a batch of hierarchies, computed on the default GPU.

    Args:
        layout: sizes and row indices (static).
        hierarchy: the numbers, with a leading axis of problems.
        tolerances: what counts as zero, one of each a problem.
        warm_start: working sets to try first; all zeros in a problem for none.
        max_iterations: limit on the active-set iterations of one level (static).
    """
    batch, count, m, n = hierarchy.levels.matrix.shape
    h = hierarchy.hard.shape[1]
    levels = hierarchy.levels
    # rows without padding, and column by column, so that the threads of a warp read neighbours
    rows = jnp.concatenate([levels.matrix[:, k, :size] for k, size in enumerate(layout.row_counts)], 1)
    numbers = (jnp.swapaxes(rows, 1, 2), levels.lower, levels.upper, hierarchy.hard[:, n:], hierarchy.hard_lower)
    numbers += (hierarchy.hard_upper, jnp.stack(hierarchy.damping[:3], -1), hierarchy.damping.bends)
    numbers += (jnp.stack(tolerances, -1),)
    flags = (hierarchy.is_equality, hierarchy.hard_is_equality, *first_working_sets(hierarchy, warm_start))
    double, whole = jnp.float64, jnp.int32
    shapes: dict[str, tuple[tuple[int, ...], Any]] = dict(x=((n,), double), multipliers=((count, h), double))
    shapes |= dict(slack_norms=((count,), double), dampings=((count,), double), residual=((), double))
    shapes |= dict(active_bounds=((n,), whole), active=((count, h), whole), frozen=((count, h), whole))
    shapes |= dict(in_cost=((count, m), whole), own=((count, m), whole), ranks=((count,), whole), report=((3,), whole))
    results = _cuda.call(
        _source(layout, max_iterations),
        [((batch, *shape), dtype) for shape, dtype in shapes.values()],
        *map(_cuda.as_double, numbers),
        *(jnp.asarray(a, jnp.int32) for a in flags),
        problems=batch,
        shared=_bytes(layout),
    )
    dtype = hierarchy.levels.matrix.dtype
    results = [a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a for a in results]
    return result_of_kernel(KernelAnswers(**dict(zip(shapes, results, strict=True))))
