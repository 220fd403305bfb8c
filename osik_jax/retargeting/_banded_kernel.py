"""Banded systems on a GPU: ``core/banded.cu``, one warp of 32 threads for each system, in single precision."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import _build, _cuda

if TYPE_CHECKING:
    from ._banded import BandedSystem

_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""


def fits(system: BandedSystem) -> bool:
    """Whether there is a kernel for systems of this shape and precision."""
    m, n = system.rows.shape[-2:]
    is_small = 4 * (4 * n * (n | 1) + 2 * m * n + 6 * n) <= _SHARED_BYTES
    return system.rows.dtype == jnp.float32 and is_small and _cuda.installed()


def solve(system: BandedSystem, right: Float[Array, "B F n"]) -> Float[Array, "B F n"]:
    """The solutions of a batch, on the GPU that the program runs on."""
    lanes, frames, n = right.shape
    single, blocks = jnp.float32, (lanes, frames, n, n)
    x, *_ = _cuda.call(
        _source(n, system.rows.shape[-2]),
        [(right.shape, single), (blocks, single), (blocks, single)],
        *(*system, right, jnp.full(1, frames, jnp.int32)),
        problems=lanes,
        shared=0,
    )
    return x


@cache
def _source(n: int, m: int) -> str:
    return _cuda.constants(N=n, M=m) + (_build.FOLDER / "banded.cu").read_text()
