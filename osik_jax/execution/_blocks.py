"""Computation of a long batch in blocks that stay in the CPU's cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ._lapack import lanes_in_one
from ._platform import cpu_is_default, is_symbolic
from ._workers import too_few_workers, warn_of_few_workers

BLOCK = 16
"""Lanes that a CPU core takes through a step at a time, so that what they need stays in its second cache.

The solvers have the same, so that a block of a step is one of theirs.
"""


def in_blocks(function: Callable[..., Any], args: tuple[Any, ...], size: int) -> Any:
    """Return ``function(*args)``, computed on a CPU in blocks of lanes, one after another.

    A symbolic number of lanes (``jax.export``) is one block. All arrays have a leading axis of lanes. The last block is
    padded with copies of the first lane. Blocks are smaller if a LAPACK call of this size would be split among too few
    workers.
    """
    count = jax.tree.leaves(args)[0].shape[0]
    if is_symbolic(count):
        return function(*args)
    if count > 1 and too_few_workers():
        warn_of_few_workers()
        size = lanes_in_one(function, args, min(size, count))
    if count <= size or not cpu_is_default():
        return function(*args)
    blocks = -(-count // size)
    padding = blocks * size - count

    def split(a: jax.Array) -> jax.Array:
        filled = jnp.concatenate([a, jnp.broadcast_to(a[:1], (padding, *a.shape[1:]))]) if padding else a
        return filled.reshape(blocks, size, *a.shape[1:])

    out = jax.lax.map(lambda block: function(*block), jax.tree.map(split, args))
    return jax.tree.map(lambda a: first_axes_as_one(a)[:count], out)


def first_axes_as_one(a: jax.Array) -> jax.Array:
    """Return the array with its first two axes merged."""
    return a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])
