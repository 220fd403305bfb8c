"""Small dense matrices: products in full precision on every device (GPUs default to TF32)."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_Function = TypeVar("_Function", bound=Callable[..., Any])

_ONE_THREAD = 31
"""Largest number of terms that XLA sums in one thread of a GPU."""


def full_precision(function: _Function) -> _Function:
    """Return the function with all its products, and those of its derivatives, in full precision."""

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            return function(*args, **options)

    return cast(Any, call)


def product(a: Float[Array, "*B m k"], b: Float[Array, "*B k n"]) -> Float[Array, "*B m n"]:
    """Return the matrix a b, or each of a batch."""
    return jnp.matmul(a, b, precision="highest")


def apply(a: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return the vector a x."""
    return jnp.matmul(a, x, precision="highest")


def short_sum(a: Float[Array, "*B n"]) -> Float[Array, "*B"]:
    """Return the sums along the last axis, of tens of numbers each, for a GPU.

    XLA adds up to 31 numbers in one thread; from 32 on a warp takes each sum, which is longer at work for fewer than
    hundreds. So longer ones are cut.
    """
    parts = max(1, -(-a.shape[-1] // _ONE_THREAD))
    first, *rest = (jnp.sum(part, -1) for part in jnp.array_split(a, parts, -1))
    return sum(rest, first)
