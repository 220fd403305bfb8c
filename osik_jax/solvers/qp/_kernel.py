"""The CUDA kernel of the weighted QP: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads solves one problem and stops when that one is done. ``_active_set.cu`` is compiled for the number
of variables, of rows of the cost and of soft rows, once a process (and once for all in Warp's cache on disk).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._cost import LeastSquares
from ._problem import QP

MOST_VARIABLES, MOST_SOFT_ROWS = 64, 32
_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_MOST_WARPS = 4
_INPUTS = dict(
    matrix="float", target="float", weight="float", damping="float", center="float", lower="float", upper="float"
) | dict(rows="float", compliance="float", guess="int", tolerance="float")
_OUTPUTS = dict(solution="float", row_multipliers="float", active="int", report="int")


class Proposal(NamedTuple):
    """What a kernel makes of a batch of problems, which another has to certify; the leading axes are the lanes."""

    x: Float[Array, "B n"]
    row_multipliers: Float[Array, "B p"]
    active: Int[Array, "B n+p"]
    settled: Int[Array, " B"]  # whether it has nothing left to change
    iterations: Int[Array, " B"]
    factorizations: Int[Array, " B"]


class Shape(NamedTuple):
    """What a kernel is compiled for."""

    variables: int
    rows: int
    soft_rows: int

    @property
    def warps(self) -> int:
        """How many of them a block can have; 0 for a problem too large for this kernel."""
        n, m, p = self
        if n > MOST_VARIABLES or p > MOST_SOFT_ROWS:
            return 0
        groups = (n + 3) // 4
        length = 4 * (groups | 1)
        floats = (m + p + 1) * length + n * length + 5 * length + 3 * (m + p + 3) + p + 3
        return min(_MOST_WARPS, _SHARED_BYTES // (4 * floats))


def propose(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Proposal:
    """Active sets, minimisers and row multipliers of a batch, on the CUDA device that the program runs on."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    lanes, m, n = cost.matrix.shape
    p = qp.rows.shape[1]
    shape = Shape(n, m, p)
    solve = _kernel(shape)
    given = (cost.matrix, cost.target, cost.weight, cost.damping, cost.center)
    given = (*given, qp.lower, qp.upper, qp.rows, qp.compliance)
    x, y, active, report = solve(
        *(_filled(a.reshape(lanes, -1)) for a in (*given, guess.astype(jnp.int32), tolerance[:, None])),
        max_iterations,
        launch_dims=32 * lanes,
        output_dims=dict(
            solution=(lanes, n), row_multipliers=(lanes, max(p, 1)), active=(lanes, n + p), report=(lanes, 3)
        ),
    )
    return Proposal(x, y[:, :p], active, *(report[:, i] for i in range(3)))


def _filled(a: Array) -> Array:
    """Something in the place of nothing: no kernel takes an empty array."""
    return a if a.shape[1] else jnp.zeros((1, 1), a.dtype)


@cache
def _kernel(shape: Shape) -> Callable[..., Any]:
    """The kernel as a function of JAX arrays."""
    warp = import_module("warp")
    types = {"float": warp.array2d(dtype=warp.float32), "int": warp.array2d(dtype=warp.int32)}
    inputs = {name: types[kind] for name, kind in _INPUTS.items()} | dict(most_changes=warp.int32)
    outputs = {name: types[kind] for name, kind in _OUTPUTS.items()}

    def solve_by_warp(
        matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, most_changes,
        solution, row_multipliers, active, report, pid,
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    solve = warp.func_native(source(shape))(solve_by_warp)

    def solve_all(
        matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, most_changes,
        solution, row_multipliers, active, report,
    ):  # fmt: skip
        solve(
            matrix, target, weight, damping, center, lower, upper, rows, compliance, guess, tolerance, most_changes,
            solution, row_multipliers, active, report, warp.tid() // 32,
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # what XLA calls it: the same in every process, for caches of compiled programs
    solve_all.__qualname__ = solve_all.__name__ = "solve_qp_" + "_".join(map(str, shape))
    block = 32 * shape.warps
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=block)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=block)


def source(shape: Shape) -> str:
    """The CUDA text of a shape."""
    n, m, p = shape
    body = files("osik_jax.solvers.qp").joinpath("_active_set.cu").read_text()
    return f"constexpr int N = {n}, M = {m}, P = {p}, WARPS = {shape.warps};\n{body}"
