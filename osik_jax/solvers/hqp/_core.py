"""Candidates for hierarchies from the core (``core/hierarchy.hpp``); on a GPU one warp of 32 threads a problem."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core import _cuda, _library
from ._cascade import CascadeResult
from ._implicit_diff import ActiveSets
from ._problem import Layout, PaddedHierarchy, Tolerances, WorkingSet


def solve(
    layout: Layout,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
    max_iterations: int,
) -> CascadeResult:
    """Return candidates for a batch of hierarchies, for all levels including the last.

    Arrays have a leading axis of problems. ``warm_start`` has the working sets to try first, all zeros for none;
    ``max_iterations`` limits the active-set iterations of one level.
    """

    def call(shapes: _library.Shapes, numbers: list[Array], integers: list[Array]) -> list[Array]:
        sizes = layout.row_counts, layout.level_of_hard, layout.row_of_hard, [max_iterations]
        return _library.call("hierarchy", shapes, *numbers, *integers, *(np.array(a, np.int32) for a in sizes))

    return answers(call, hierarchy, tolerances, warm_start)


def answers(
    call: Callable[[_library.Shapes, list[Array], list[Array]], list[Array]],
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
) -> CascadeResult:
    """Return a kernel's uncertified answers in the form of the search's.

    ``call`` is given the shapes of the results, in the order of ``Answer`` in ``core/hierarchy.hpp``, and the numbers
    and the integers of ``Problem``.
    """
    batch, count, m, n = hierarchy.levels.matrix.shape
    h = hierarchy.hard.shape[1]
    levels, damping = hierarchy.levels, hierarchy.damping
    numbers = [levels.matrix, levels.lower, levels.upper, hierarchy.hard[:, n:], hierarchy.hard_lower]
    numbers += [hierarchy.hard_upper, jnp.stack(damping[:3], -1), damping.bends, jnp.stack(tolerances, -1)]
    guess = warm_start or (jnp.zeros((batch, count, h), int), jnp.zeros((batch, count, m), int))
    labels = (n,), (count, h), (count, h), (count, m), (count, m), (count,), (3,)
    shapes = _library.shapes_of(batch, ((n,), (count, h), (count,), (count,), ()), labels)
    integers = [levels.equal, hierarchy.hard_is_equality, *guess]
    x, multipliers, slack_norms, dampings, residual, *others = call(shapes, numbers, integers)
    active_bounds, active, frozen, in_cost, own, ranks, report = others
    # the derivative keeps rows that a damped level has at their bounds, frozen or not
    kept = jnp.where(dampings[:, :, None] > 0.0, active, frozen)
    sets = active_bounds, ActiveSets(kept, frozen, in_cost, ranks), WorkingSet(active, own)
    ended, iterations, factorizations = (report[:, k] for k in range(3))
    return CascadeResult(x, *sets, multipliers, slack_norms, residual, iterations, factorizations, ended != 0)


_MAX_ROWS = 64  # the triangular solves of a warp hold two entries a thread
_KERNEL = """
using namespace osik;
using Method = Hierarchy<Warp<double, N, M, H>>;
extern "C" __global__ void __launch_bounds__(32, BLOCKS) osik_kernel(
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


def _bytes(layout: Layout) -> int:
    return _cuda.space_of("hierarchy", layout.levels, layout.rows, layout.variables, len(layout.level_of_hard))


def fits(layout: Layout) -> bool:
    """Return whether a GPU has room for a problem."""
    return _cuda.installed() and layout.rows <= _MAX_ROWS and _bytes(layout) <= _cuda.shared_bytes()


@cache
def _source(layout: Layout, max_iterations: int) -> str:
    n, h = layout.variables, len(layout.level_of_hard)
    numbers = dict(N=n, M=layout.rows, H=h, L=layout.levels, ROWS=sum(layout.row_counts))
    numbers |= dict(MAX_ITERATIONS=max_iterations, BLOCKS=_cuda.blocks_beside(_bytes(layout)))
    lists = dict(ROW_COUNTS=layout.row_counts, LEVEL_OF_HARD=layout.level_of_hard, ROW_OF_HARD=layout.row_of_hard)
    return _cuda.text_of("hierarchy.hpp") + _cuda.constants(**numbers, **lists) + _KERNEL


def solve_on_gpu(
    layout: Layout,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
    max_iterations: int,
) -> CascadeResult:
    """Return candidates for a batch of hierarchies, computed on the default GPU; arguments as for ``solve``."""

    def call(shapes: _library.Shapes, numbers: list[Array], integers: list[Array]) -> list[Array]:
        # rows without padding, and column by column, so that the threads of a warp read neighbours
        rows = jnp.concatenate([numbers[0][:, k, :size] for k, size in enumerate(layout.row_counts)], 1)
        return _cuda.call(
            _source(layout, max_iterations),
            shapes,
            *map(_cuda.as_double, (jnp.swapaxes(rows, 1, 2), *numbers[1:])),
            *(jnp.asarray(a, jnp.int32) for a in integers),
            problems=len(rows),
            shared=_bytes(layout),
        )

    return answers(call, hierarchy, tolerances, warm_start)
