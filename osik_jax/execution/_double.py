"""Double precision inside a program with data in single precision.

Whether a bound is active and whether a pivot exceeds its tolerance are yes-or-no decisions. A decision reversed by
rounding can cost a lower level its optimum. Data in single precision cost almost no accuracy as long as computations
are in double precision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def in_double(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function computed in double precision; its floats are returned in the precision of the first one."""

    def wide(*args: Any) -> Any:
        given = next(a.dtype for a in jax.tree.leaves(args) if _is_float(a))
        with jax.enable_x64(True):
            return _cast(function(*_cast(args, jnp.float64)), given)

    return wide


def _cast(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda a: a.astype(dtype) if _is_float(a) else a, tree)


def _is_float(a: Array) -> bool:
    return jnp.issubdtype(a.dtype, jnp.floating)


def first_smallest(a: Float[Array, " m"]) -> Int[Array, ""]:
    """Return the index of the smallest number, the first one in a tie.

    ``jnp.argmin`` does not compile for doubles in a program whose default is single.
    """
    index = jax.lax.iota(jnp.int32, a.shape[0])
    return jnp.minimum(jnp.min(jnp.where(a == jnp.min(a), index, a.shape[0])), a.shape[0] - 1)
