"""CUDA kernel for banded systems in single precision (``core/banded.cu``); one warp of 32 threads solves one system."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import _build, _cuda

if TYPE_CHECKING:
    from ._banded import BandedSystem

_SHARED_BYTES = 48 * 1024
"""Shared memory [bytes] that every CUDA device offers a block by default."""


def fits(system: BandedSystem) -> bool:
    """Return whether the kernel supports the shape and precision of a system."""
    m, n = system.rows.shape[-2:]
    is_small = 4 * (4 * n * (n | 1) + 2 * m * n + 6 * n) <= _SHARED_BYTES
    return system.rows.dtype == jnp.float32 and is_small and _cuda.installed()


def solve(system: BandedSystem, right: Float[Array, "B F n"]) -> Float[Array, "B F n"]:
    """Return the solutions of a batch of banded systems, computed on the default GPU."""
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
