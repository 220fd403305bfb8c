"""The CUDA kernel of banded systems: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads solves one system, from its first frame to its last and back, in single precision.
``_banded.cu`` is compiled for the numbers of dofs and of coupled rows, once a process (and once for all in Warp's cache
on disk).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

if TYPE_CHECKING:
    from ._banded import BandedSystem

_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_INPUTS: dict[str, str] = dict.fromkeys(("square", "alone", "rows", "weight", "first", "second", "right"), "float")
_OUTPUTS: dict[str, str] = dict(solution="float", near="float", inverse="float")


def fits(system: BandedSystem) -> bool:
    """Whether there is a kernel for systems of this shape and precision."""
    m, n = system.rows.shape[-2:]
    return system.rows.dtype == jnp.float32 and 4 * (4 * n * (n | 1) + 2 * m * n + 6 * n) <= _SHARED_BYTES


def solve(system: BandedSystem, right: Float[Array, "B F n"]) -> Float[Array, "B F n"]:
    """The solutions of a batch, on the CUDA device that the program runs on."""
    lanes, frames, n = right.shape
    x, *_ = _kernel(n, system.rows.shape[-2])(
        *(a.reshape(lanes, -1) for a in (*system, right)),
        frames,
        launch_dims=32 * lanes,
        output_dims=dict(solution=(lanes, frames * n), near=(lanes, frames * n * n), inverse=(lanes, frames * n * n)),
    )
    return x.reshape(right.shape)


@cache
def _kernel(n: int, m: int) -> Callable[..., Any]:
    """The kernel as a function of JAX arrays."""
    warp = import_module("warp")
    kind = warp.array2d(dtype=warp.float32)
    inputs = dict.fromkeys(_INPUTS, kind) | dict(most_changes=warp.int32)
    outputs = dict.fromkeys(_OUTPUTS, kind)

    def solve_by_warp(
        square, alone, rows, weight, first, second, right, most_changes, solution, near, inverse, pid
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    own = warp.func_native(source(n, m))(solve_by_warp)

    def solve_all(square, alone, rows, weight, first, second, right, most_changes, solution, near, inverse):
        own(
            square, alone, rows, weight, first, second, right, most_changes, solution, near, inverse, warp.tid() // 32
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # what XLA calls it: the same in every process, for caches of compiled programs
    solve_all.__qualname__ = solve_all.__name__ = f"solve_banded_{n}_{m}"
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=32)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=32)


def source(n: int, m: int) -> str:
    """The CUDA text for n dofs and m coupled rows."""
    return f"constexpr int N = {n}, M = {m};\n" + files("osik_jax.retargeting").joinpath("_banded.cu").read_text()
