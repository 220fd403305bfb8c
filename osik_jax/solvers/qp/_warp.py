"""The CUDA kernel of the weighted QP: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads solves one problem and stops when that one is done. The text in ``kernels/warp/qp`` is compiled
for the number of variables, of rows of the cost and of soft rows, once a process (and once for all in Warp's cache on
disk).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...kernels.warp import text
from ...numerics._constants import (
    KERNEL_REFINEMENTS,
    KKT_RIDGE,
    LAST_CORRECTION,
    MAX_EXCHANGES,
    MAX_FACTORIZATIONS,
    MIN_DECREASE,
    VIOLATION_TOL,
)
from ._candidate import Candidate
from ._cost import LeastSquares
from ._problem import QP

PARTS = ("workspace", "vectors", "problem", "factor", "refine", "labels", "dual_step", "active_set")
"""The files of the kernel, in their order: each uses what those before it define."""
MAX_VARIABLES, MAX_SOFT_ROWS = 64, 32
_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_MAX_WARPS = 4
_INPUTS = dict(
    matrix="float", target="float", weight="float", damping="float", center="float", lower="float", upper="float"
) | dict(rows="float", compliance="float", guess="int", tolerance="float")
_OUTPUTS = dict(solution="float", row_multipliers="float", active="int", report="int")


class Shape(NamedTuple):
    """The numbers that a kernel is compiled for."""

    variables: int
    rows: int
    soft_rows: int

    @property
    def warps(self) -> int:
        """The number of warps of a block; 0 for a problem that is too large for this kernel."""
        n, m, p = self
        if n > MAX_VARIABLES or p > MAX_SOFT_ROWS:
            return 0
        groups = (n + 3) // 4
        length = 4 * (groups | 1)
        floats = (m + p + 1) * length + n * length + 5 * length + 3 * (m + p + 3) + p + 3
        return min(_MAX_WARPS, _SHARED_BYTES // (4 * floats))


def solve(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Candidate:
    """Return candidates for a batch, on the CUDA device that the program runs on.

    Args:
        qp: the problems, with a leading axis; in single precision.
        guess: labels of the active sets to try first.
        tolerance: violation that counts as none, relative to the scale of the constraint.
        max_iterations: limit on the changes of the active set (static).
    """
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    batch, m, n = cost.matrix.shape
    p = qp.rows.shape[1]
    shape = Shape(n, m, p)
    kernel = _kernel(shape)
    given = (cost.matrix, cost.target, cost.weight, cost.damping, cost.center)
    given = (*given, qp.lower, qp.upper, qp.rows, qp.compliance)
    x, y, active, report = kernel(
        *(_not_empty(a.reshape(batch, -1)) for a in (*given, guess.astype(jnp.int32), tolerance[:, None])),
        max_iterations,
        launch_dims=32 * batch,
        output_dims=dict(
            solution=(batch, n), row_multipliers=(batch, max(p, 1)), active=(batch, n + p), report=(batch, 3)
        ),
    )
    return Candidate(x, y[:, :p], active, *(report[:, i] for i in range(3)))


def _not_empty(a: Array) -> Array:
    """Return a placeholder for an empty array, which no kernel takes."""
    return a if a.shape[1] else jnp.zeros((1, 1), a.dtype)


@cache
def _kernel(shape: Shape) -> Callable[..., Any]:
    """Return the kernel as a function of JAX arrays."""
    warp = import_module("warp")
    types = {"float": warp.array2d(dtype=warp.float32), "int": warp.array2d(dtype=warp.int32)}
    inputs = {name: types[kind] for name, kind in _INPUTS.items()} | dict(max_iterations=warp.int32)
    outputs = {name: types[kind] for name, kind in _OUTPUTS.items()}

    def solve_by_warp(
        matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, max_iterations,
        solution, row_multipliers, active, report, pid,
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    solve = warp.func_native(source(shape))(solve_by_warp)

    def solve_all(
        matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, max_iterations,
        solution, row_multipliers, active, report,
    ):  # fmt: skip
        solve(
            matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, max_iterations,
            solution, row_multipliers, active, report, warp.tid() // 32,
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # what XLA calls it: the same in every process, for caches of compiled programs
    solve_all.__qualname__ = solve_all.__name__ = "solve_qp_" + "_".join(map(str, shape))
    block = 32 * shape.warps
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=block)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=block)


def source(shape: Shape, parts: tuple[str, ...] = PARTS) -> str:
    """Return the CUDA text for a shape: its numbers as constants, then the body of the kernel, or some of its parts."""
    n, m, p = shape
    single = jnp.dtype("float32")
    numbers = dict(MAX_REFINEMENTS=KERNEL_REFINEMENTS[single], MAX_FACTORIZATIONS=MAX_FACTORIZATIONS)
    numbers |= dict(MAX_EXCHANGES=MAX_EXCHANGES)
    constants = dict(RIDGE=KKT_RIDGE[single] * float(jnp.finfo(single).eps), LAST_CORRECTION=LAST_CORRECTION[single])
    constants |= dict(VIOLATION_TOL=VIOLATION_TOL, MIN_DECREASE=MIN_DECREASE)
    head = [f"constexpr int N = {n}, M = {m}, P = {p}, WARPS = {shape.warps};"]
    head += [f"constexpr int {name} = {value};" for name, value in numbers.items()]
    head += [f"constexpr float {name} = {value!r}f;" for name, value in constants.items()]
    return "\n".join(head) + "\n" + text("qp", parts)
