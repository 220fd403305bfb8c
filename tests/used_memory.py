"""Kernels on memory that was used before: what they are given to write to holds numbers of somebody else's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from osik_jax.kernels.numba import _target

Leaf = jax.ShapeDtypeStruct

CANARY = 1234.5678
BEHIND = 64
"""Numbers behind the space of a kernel, which it may not touch."""


@contextmanager
def used_memory(monkeypatch: pytest.MonkeyPatch, left: float) -> Iterator[None]:
    """Fill the results and the space of every kernel before it is called, in programs that are traced meanwhile.

    XLA is told that each result lies where one more argument lies. A kernel that writes behind its space has NaN for
    results.

    Args:
        monkeypatch: of the test.
        left: what is in the memory, such as NaN.
    """
    ffi_call = jax.ffi.ffi_call

    def call(name: str, shapes: list[Leaf]) -> Callable[..., list[Any]]:
        wider = [Leaf((s.shape[0] + BEHIND,), s.dtype) if _is_space(s) else s for s in shapes]

        def on_used_memory(*inputs: Any) -> list[Any]:
            aliases = {len(inputs) + k: k for k in range(len(wider))}
            found = ffi_call(name, wider, input_output_aliases=aliases)(*inputs, *(_used(s, left) for s in wider))
            behind = [a[-BEHIND:] for a, s in zip(found, shapes, strict=True) if _is_space(s)]
            kept = jnp.all(jnp.array(behind) == CANARY)
            return [_checked(a, s, kept) for a, s in zip(found, shapes, strict=True)]

        return on_used_memory

    jax.clear_caches()
    with monkeypatch.context() as patched:
        patched.setattr(_target.jax.ffi, "ffi_call", call)
        yield
    jax.clear_caches()


def _is_space(shape: Leaf) -> bool:
    return len(shape.shape) == 1 and shape.dtype == jnp.float64


def _used(shape: Leaf, left: float) -> jax.Array:
    if shape.dtype != jnp.float64:
        return jnp.full(shape.shape, 0x55555555, shape.dtype)
    memory = jnp.full(shape.shape, left, shape.dtype)
    return memory.at[-BEHIND:].set(CANARY) if _is_space(shape) else memory


def _checked(found: jax.Array, shape: Leaf, kept: jax.Array) -> jax.Array:
    if _is_space(shape):
        return found[: shape.shape[0]]
    return jnp.where(kept, found, jnp.nan) if shape.dtype == jnp.float64 else found
