"""Numbers of the host: what is known while a robot or a task is made is computed by NumPy, and XLA compiles nothing."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # in JAX 0.8
    from jax.core import get_opaque_trace_state  # pyright: ignore[reportAttributeAccessIssue]

if TYPE_CHECKING:
    Numbers: TypeAlias = Any  # an operator of both is none of their union's
else:
    Numbers = jax.Array | np.ndarray | np.generic
"""An array of JAX, or of NumPy for what is computed on the host."""


def float_now() -> np.dtype:
    """Return the type of JAX's floats, ``jnp.result_type(float)``, which takes longer to ask."""
    return np.dtype(np.float64 if jax.config.jax_enable_x64 else np.float32)  # pyright: ignore[reportAttributeAccessIssue]


def module_of(array: Any) -> ModuleType:
    """Return ``numpy`` for NumPy's arrays and numbers, else ``jax.numpy``: one text serves the host and programs."""
    return np if isinstance(array, np.ndarray | np.generic) else jnp


def is_traced(tree: Any) -> bool:
    """Return whether a leaf of the tree is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def untraced() -> AbstractContextManager[None]:
    """Return a context in which operations on numbers are run, also where a program is being traced.

    ``jax.ensure_compile_time_eval`` alone would also run what is constant in programs that are first called in it: each
    operation is a program of its own, and an inverse by tasks has hundreds.
    """
    return nullcontext() if get_opaque_trace_state("flax") == _OUTSIDE else jax.ensure_compile_time_eval()


_OUTSIDE = get_opaque_trace_state("flax")
"""The state of JAX where nothing is traced; another one if this module is first imported inside a program."""


def to_host(value: Any, dtype: Any = None) -> np.ndarray:
    """Return a copy of real numbers as an array of NumPy."""
    host = np.array(value)
    if host.dtype != bool and not any(jnp.issubdtype(host.dtype, kind) for kind in (jnp.floating, jnp.integer)):
        raise TypeError(f"{host.dtype} is no type of real numbers")
    return host if dtype is None else host.astype(dtype, copy=False)


def to_jax(value: Any, dtype: Any = None) -> Array:
    """Return ``jnp.asarray(value, dtype)`` without the program that it compiles for each shape of NumPy's arrays."""
    if isinstance(value, jax.Array):
        return jnp.asarray(value, dtype)
    try:
        return jax.device_put(to_host(value, dtype))  # a copy: the device may keep the memory that it is given
    except (TypeError, ValueError):  # parts are traced, or the message is that of JAX
        return jnp.asarray(value, dtype)


def tree_to_jax(tree: Any) -> Any:
    """Return a pytree of arrays as arrays of JAX, floats in its present precision; one transfer if none is traced."""
    now = float_now()
    types = jax.tree.map(lambda leaf: now if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype, tree)
    if is_traced(tree):
        return jax.tree.map(jnp.asarray, tree, types)
    return jax.device_put(jax.tree.map(to_host, tree, types))


def repeated(array: Array, shape: tuple[int, ...]) -> Array:
    """Return ``jnp.broadcast_to(array, shape)`` without compiling."""
    if array.shape == shape:
        return array
    return jnp.broadcast_to(array, shape) if is_traced(array) else to_jax(np.broadcast_to(np.asarray(array), shape))


def on_host(array: Any) -> Numbers:
    """Return an array as one of NumPy, a traced one as it is."""
    return array if isinstance(array, Tracer) else np.asarray(array)


def replaced_at(array: Numbers, index: Any, value: Any) -> Numbers:
    """Return the array with other numbers at an index; on the host, unless one of both is traced."""
    if is_traced((array, value)):
        return jnp.asarray(array).at[index].set(value)
    out = np.array(array)
    out[index] = value
    return out
