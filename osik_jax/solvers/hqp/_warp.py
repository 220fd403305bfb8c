"""The CUDA kernel of the hierarchy: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads goes through all levels of one problem, in double precision. The text in ``kernels/warp/hqp`` is
compiled for the layout of the hierarchy, once a process (and once for all in Warp's cache on disk).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ...kernels.warp import rolled, text
from ...numerics._constants import (
    COST_FRACTION,
    DAMPING_ITERATIONS,
    DAMPING_RIDGE,
    EPSILON,
    EXTRA_DAMPING,
    FACTOR_RIDGE,
    MAX_ATTEMPTS,
    MAX_DETOUR,
    MAX_STALLED,
    MIN_RADIUS,
    NEGLIGIBLE_CURVATURE,
    NEGLIGIBLE_DAMPING,
    STATIONARITY_TOL,
    TIE_ROUNDOFF,
)
from ._cascade import CascadeResult, KernelAnswers, first_working_sets, result_of_kernel
from ._padding import Layout, PaddedHierarchy
from ._problem import Tolerances, WorkingSet

PARTS = (
    *("workspace", "reductions", "problem", "level", "basis", "cholesky", "active_rows", "least_squares"),
    *("multipliers", "evaluate", "damping", "warm_start", "primal_active_set", "freeze", "cascade"),
)
"""The files of the kernel, in their order: each uses what those before it define."""
_MAX_ROWS, _MAX_HARD_ROWS = 64, 32
_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_MAX_WARPS = 2
_INPUTS = (
    dict(matrix="double", rows_lower="double", rows_upper="double", rows_equal="int")
    | dict(hard_lower="double", hard_upper="double", hard_equal="int")
    | dict(guess_hard="int", guess_own="int", dampings="double", bends="double", tolerances="double")
)
_OUTPUTS = dict(
    solution="double",
    active_bounds="int",
    active_rows="int",
    frozen_rows="int",
    rows_in_cost="int",
    own_rows="int",
    ranks="int",
) | dict(multipliers="double", slack_norms="double", level_dampings="double", residuals="double", report="int")


class Shape(NamedTuple):
    """The numbers of a layout that a kernel is compiled for."""

    variables: int
    rows: int  # of the longest level
    row_counts: tuple[int, ...]  # rows of each level
    has_inequalities: tuple[bool, ...]  # levels that may have inequalities
    row_of_hard: tuple[int, ...]  # index of each hard row beside the box among the rows of all levels
    level_of_hard: tuple[int, ...]  # level of each of those

    @classmethod
    def of(cls, layout: Layout) -> Shape:
        """Return the shape of a hierarchy."""
        n, h = layout.variables, len(layout.level_of_hard)
        offsets = [sum(layout.row_counts[:k]) for k in range(layout.levels)]
        row_of_hard = {
            q: offsets[k] + a for k, indices in enumerate(layout.hard_of_row) for a, q in enumerate(indices) if q < h
        }
        level_of_hard = layout.level_of_hard[n:]
        has_inequalities = tuple(k in level_of_hard for k in range(layout.levels))
        rows = tuple(row_of_hard[q] for q in range(n, h))
        return cls(n, layout.rows, layout.row_counts, has_inequalities, rows, level_of_hard)

    @property
    def all_rows(self) -> int:
        """The number of rows of all levels together."""
        return sum(self.row_counts)

    @property
    def warps(self) -> int:
        """The number of warps of a block; 0 for a problem that is too large for this kernel."""
        n, m, p = self.variables, self.rows, len(self.row_of_hard)
        if m > _MAX_ROWS or p > _MAX_HARD_ROWS or not self.all_rows:
            return 0
        # rows and columns have odd lengths, so that the threads of a warp read from different banks of memory
        row, column = n | 1, m | 1
        rank = min(n, m)
        factors = n * column + m * row
        doubles = n * row + factors + max(p, 1) * row + 4 * max(n, m, p) + rank + m * (column + 1)
        return min(_MAX_WARPS, _SHARED_BYTES // (8 * doubles + 4 * (2 * n + m)))


def solve(
    layout: Layout,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
    max_iterations: int,
) -> CascadeResult:
    """Return candidates for a batch of hierarchies, on the CUDA device that the program runs on; all levels.

    Args:
        layout: sizes and row indices (static).
        hierarchy: the numbers, with a leading axis of problems.
        tolerances: what counts as zero, one of each a problem.
        warm_start: working sets to try first; all zeros in a problem for none.
        max_iterations: limit on the active-set iterations of one level (static).
    """
    shape = Shape.of(layout)
    batch, count, m, n = hierarchy.levels.matrix.shape
    h = hierarchy.hard.shape[1]
    sizes = dict(
        solution=n,
        active_bounds=n,
        active_rows=count * h,
        frozen_rows=count * h,
        rows_in_cost=count * m,
        own_rows=count * m,
    )
    sizes |= dict(ranks=count, multipliers=count * h, slack_norms=count, level_dampings=count, residuals=1, report=3)
    results = _kernel(shape)(
        *(a.reshape(batch, -1) for a in _inputs(shape, hierarchy, tolerances, warm_start)),
        max_iterations,
        launch_dims=32 * batch,
        output_dims={name: (batch, size) for name, size in sizes.items()},
    )
    x, active_bounds, active, frozen, in_cost, own, ranks, multipliers, slack_norms, dampings, residual, report = (
        results
    )
    active, frozen, multipliers = (a.reshape(batch, count, h) for a in (active, frozen, multipliers))
    in_cost, own = (a.reshape(batch, count, m) for a in (in_cost, own))
    return result_of_kernel(
        KernelAnswers(
            x=x,
            multipliers=multipliers,
            slack_norms=slack_norms,
            dampings=dampings,
            residual=residual[:, 0],
            active_bounds=active_bounds,
            active=active,
            frozen=frozen,
            in_cost=in_cost,
            own=own,
            ranks=ranks,
            report=report,
        )
    )


def _inputs(
    shape: Shape, hierarchy: PaddedHierarchy, tolerances: Tolerances, warm_start: WorkingSet | None
) -> tuple[Array, ...]:
    """Return the kernel's arrays in the order of ``_INPUTS``, with a leading axis of problems; levels not padded."""

    def without_padding(a: Array) -> Array:
        return jnp.concatenate([a[:, k, :size] for k, size in enumerate(shape.row_counts)], 1)

    levels, is_equality = hierarchy.levels, hierarchy.is_equality.astype(jnp.int32)
    return (
        jnp.swapaxes(without_padding(levels.matrix), 1, 2),
        *(without_padding(a) for a in (levels.lower, levels.upper, is_equality)),
        *(hierarchy.hard_lower, hierarchy.hard_upper, hierarchy.hard_is_equality.astype(jnp.int32)),
        *(a.astype(jnp.int32) for a in first_working_sets(hierarchy, warm_start)),
        jnp.stack(hierarchy.damping[:3], 1),
        hierarchy.damping.bends,
        jnp.stack(tolerances, -1),
    )


@cache
def _kernel(shape: Shape) -> Callable[..., Any]:
    """Return the kernel as a function of JAX arrays."""
    warp = import_module("warp")
    types = {"double": warp.array2d(dtype=warp.float64), "int": warp.array2d(dtype=warp.int32)}
    inputs = {name: types[kind] for name, kind in _INPUTS.items()} | dict(max_iterations=warp.int32)
    outputs = {name: types[kind] for name, kind in _OUTPUTS.items()}

    def solve_by_warp(
        matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
        dampings, bends, tolerances, max_iterations, solution, active_bounds, active_rows, frozen_rows, rows_in_cost,
        own_rows, ranks, multipliers, slack_norms, level_dampings, residuals, report, pid,
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    native = warp.func_native(source(shape))(solve_by_warp)

    def solve_all(
        matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
        dampings, bends, tolerances, max_iterations, solution, active_bounds, active_rows, frozen_rows, rows_in_cost,
        own_rows, ranks, multipliers, slack_norms, level_dampings, residuals, report,
    ):  # fmt: skip
        native(
            matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
            dampings, bends, tolerances, max_iterations, solution, active_bounds, active_rows, frozen_rows,
            rows_in_cost, own_rows, ranks, multipliers, slack_norms, level_dampings, residuals, report,
            warp.tid() // 32,
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # the name that XLA sees is the same in every process, so that compiled programs are found in caches
    numbers = [shape.variables, *shape.row_counts, *map(int, shape.has_inequalities), *shape.row_of_hard]
    solve_all.__qualname__ = solve_all.__name__ = "solve_hqp_" + "_".join(map(str, numbers))
    block = 32 * shape.warps
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=block)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=block)


def source(shape: Shape, parts: tuple[str, ...] = PARTS) -> str:
    """Return the CUDA text for a shape: its numbers as constants, then the body of the kernel, or some of its parts."""
    offsets = [sum(shape.row_counts[:k]) for k in range(len(shape.row_counts))]
    numbers = dict(N=shape.variables, LEVELS=len(shape.row_counts), M=shape.rows, ROWS=shape.all_rows)
    numbers |= dict(P=len(shape.row_of_hard), WARPS=shape.warps, DAMPING_ITERATIONS=DAMPING_ITERATIONS)
    numbers |= dict(MAX_ATTEMPTS=MAX_ATTEMPTS, MAX_STALLED=MAX_STALLED)
    lists = dict(COUNT=shape.row_counts, OFFSET=offsets, HAS_INEQUALITIES=[int(a) for a in shape.has_inequalities])
    lists |= dict(ROW=shape.row_of_hard or (0,), LEVEL=shape.level_of_hard or (0,))
    head = [f"constexpr int {name} = {value};" for name, value in numbers.items()]
    constants = dict(NEGLIGIBLE_DAMPING=NEGLIGIBLE_DAMPING, COST_FRACTION=COST_FRACTION, DAMPING_RIDGE=DAMPING_RIDGE)
    constants |= dict(MIN_RADIUS=MIN_RADIUS, NEGLIGIBLE_CURVATURE=NEGLIGIBLE_CURVATURE)
    constants |= dict(EXTRA_DAMPING=EXTRA_DAMPING, FACTOR_RIDGE=FACTOR_RIDGE, STATIONARITY_TOL=STATIONARITY_TOL)
    constants |= dict(TIE_ROUNDOFF=TIE_ROUNDOFF * EPSILON, MAX_DETOUR=MAX_DETOUR)
    head += [f"constexpr double {name} = {value!r};" for name, value in constants.items()]
    head += [f"const int {name}[] = {{{', '.join(map(str, values))}}};" for name, values in lists.items()]
    return "\n".join(head) + "\n" + rolled(text("hqp", parts))
