"""The CUDA kernel of saturation in the null space: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads goes through all levels of one problem, in double precision. The text in
``kernels/warp/null_space`` is compiled for the number of variables, of levels and of rows of the longest level, once a
process (and once for all in Warp's cache on disk).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import jax.numpy as jnp

from ...kernels.warp import rolled, text
from ...numerics import _constants
from ._implicit_diff import ActiveJoints, SaturatedResult
from ._padding import Problem

PARTS = (
    *("workspace", "hqp/reductions", "calls", "problem", "level", "row_space", "hqp/cholesky", "damping", "motion"),
    *("saturated", "stop", "choices", "search", "attempt", "after", "levels"),
)
"""The files of the kernel, in their order: each uses what those before it define."""
_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_MAX_ROWS, _MAX_WARPS = 64, 2
_INPUTS = (
    dict(matrix="double", rows_lower="double", rows_upper="double", rows_equal="int", dampings="double")
    | dict(bends="double", targets="double", lower="double", upper="double", rank_tolerance="double")
)  # fmt: skip
_OUTPUTS = (
    dict(solution="double", projectors="double", scales="double", dones="int", joints_at_bounds="int")
    | dict(joints_blocking="int", blockers="int", active_joints="int", report="int")
)  # fmt: skip
_WHOLE = ("DAMPING_ITERATIONS", "MAX_SATURATION_CHANGES", "PART", "PATH_SEARCHES", "SIGN_CHECKS", "STRAIGHT", "WHOLE")
_NUMBERS = (
    *("BLOCKING_RANK", "BOUND_DISTANCE", "COST_FRACTION", "DAMPING_RIDGE", "FULL_STEP", "LARGEST_RATE"),
    *("MIN_RADIUS", "NEGLIGIBLE_CURVATURE", "NEGLIGIBLE_DAMPING", "NEGLIGIBLE_ENTRY", "NEGLIGIBLE_STEP", "PATH_END"),
    *("PATH_STEP", "SATURATION_LOSS", "SATURATION_RANK", "SATURATION_RESIDUAL", "SATURATION_ROUNDOFF"),
    *("SATURATION_COMPLIANCE", "SOFT_SATURATION_RANK", "STIFFER_SATURATION_COMPLIANCE"),
)
"""Names of the constants that the text takes from ``numerics/_constants.py``."""


class Shape(NamedTuple):
    """The numbers that a kernel is compiled for."""

    variables: int
    levels: int
    rows: int  # of the longest level

    @classmethod
    def of(cls, problem: Problem) -> Shape:
        """Return the shape of a batch of problems."""
        _, levels, m, n = problem.levels.matrix.shape
        return cls(n, levels, m)

    @property
    def warps(self) -> int:
        """The number of warps of a block; 0 for a problem that is too large for this kernel."""
        n, m = self.variables, self.rows
        if m > _MAX_ROWS:
            return 0
        # rows have odd lengths, so that the threads of a warp read from different banks of memory
        wide = max(n, m)
        room = n * (wide | 1) + (0 if m * (m | 1) <= n * n else m * (m | 1))
        doubles = n * (n | 1) + room + 14 * n + 6 * m + wide
        return min(_MAX_WARPS, _SHARED_BYTES // (8 * doubles + 4 * (6 * n + m)))


def solve(problem: Problem, max_iterations: int) -> SaturatedResult:
    """Return answers for a batch of problems, on the CUDA device that the program runs on; ``done`` where it has one.

    Args:
        problem: the numbers, with a leading axis of problems; in double precision.
        max_iterations: limit on the changes of the active set, for each level (static).
    """
    shape = Shape.of(problem)
    n, count, _ = shape
    batch = len(problem.lower)
    sizes = dict(solution=n, projectors=n * n, scales=count, dones=count, joints_at_bounds=count * n)
    sizes |= dict(joints_blocking=count * n, blockers=count, active_joints=n, report=2)
    levels, damping = problem.levels, problem.damping
    given = (
        *(jnp.swapaxes(levels.matrix, 2, 3), levels.lower, levels.upper, levels.equal.astype(jnp.int32)),
        *(jnp.stack(damping[:3], 1), damping.bends, problem.targets, problem.lower, problem.upper, problem.rank_tol),
    )
    x, projector, scales, dones, at_bound, blocking, blocker, active, report = _kernel(shape)(
        *(a.reshape(batch, -1) for a in given),
        max_iterations,
        launch_dims=32 * batch,
        output_dims={name: (batch, size) for name, size in sizes.items()},
    )
    projector = projector.reshape(batch, n, n)
    at_bound, blocking = (a.reshape(batch, count, n) for a in (at_bound, blocking))
    joints = ActiveJoints(dones != 0, at_bound, blocking, blocker, dones)
    return SaturatedResult(x, projector, scales, joints, active, report[:, 1], report[:, 0] != 0)


@cache
def _kernel(shape: Shape) -> Callable[..., Any]:
    """Return the kernel as a function of JAX arrays."""
    warp = import_module("warp")
    types = {"double": warp.array2d(dtype=warp.float64), "int": warp.array2d(dtype=warp.int32)}
    inputs = {name: types[kind] for name, kind in _INPUTS.items()} | dict(max_iterations=warp.int32)
    outputs = {name: types[kind] for name, kind in _OUTPUTS.items()}

    def solve_by_warp(
        matrix, rows_lower, rows_upper, rows_equal, dampings, bends, targets, lower, upper, rank_tolerance,
        max_iterations, solution, projectors, scales, dones, joints_at_bounds, joints_blocking, blockers,
        active_joints, report, pid,
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    native = warp.func_native(source(shape))(solve_by_warp)

    def solve_all(
        matrix, rows_lower, rows_upper, rows_equal, dampings, bends, targets, lower, upper, rank_tolerance,
        max_iterations, solution, projectors, scales, dones, joints_at_bounds, joints_blocking, blockers,
        active_joints, report,
    ):  # fmt: skip
        native(
            matrix, rows_lower, rows_upper, rows_equal, dampings, bends, targets, lower, upper, rank_tolerance,
            max_iterations, solution, projectors, scales, dones, joints_at_bounds, joints_blocking, blockers,
            active_joints, report, warp.tid() // 32,
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # the name that XLA sees is the same in every process, so that compiled programs are found in caches
    solve_all.__qualname__ = solve_all.__name__ = "solve_saturated_" + "_".join(map(str, shape))
    block = 32 * shape.warps
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=block)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=block)


def source(shape: Shape, parts: tuple[str, ...] = PARTS) -> str:
    """Return the CUDA text for a shape: its numbers as constants, then the body of the kernel, or some of its parts."""
    n, levels, m = shape
    head = [f"constexpr int N = {n}, LEVELS = {levels}, M = {m}, WARPS = {shape.warps};"]
    head += [f"constexpr int {name} = {getattr(_constants, name)};" for name in _WHOLE]
    head += [f"constexpr double {name} = {getattr(_constants, name)!r};" for name in _NUMBERS]
    return "\n".join(head) + "\n" + rolled(text("null_space", parts))
