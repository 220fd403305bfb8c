"""Pytrees of numbers as one array, because each transfer to or from a GPU takes as long as a search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int

_WORD = np.dtype(np.int32)


@partial(jax.tree_util.register_dataclass, data_fields=["words", "apart"], meta_fields=["form"])
@dataclass(frozen=True)
class Packed:
    """A pytree."""

    words: Int[Array | np.ndarray, " k"]  # numbers of its packed leaves one after another, as integers of 32 bits
    apart: tuple[Array, ...]  # its leaves that are not packed
    form: Any  # shape and type of each leaf, the type None for a leaf that is apart; and the structure (static)


def call_packed(program: Callable[[Packed], Packed], *given: Any) -> Any:
    """Run a program with its arguments packed in one array; return its results as NumPy arrays."""
    return unpacked(jax.device_get(program(packed(given))))


def packed(tree: Any) -> Packed:
    """Return a packed pytree: of concrete leaves, those on a device are apart; traced ones are all packed."""
    leaves, structure = jax.tree.flatten(tree)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        arrays = [jnp.asarray(leaf) for leaf in leaves]
        words = [jax.lax.bitcast_convert_type(a.astype(_stored(a.dtype)), _WORD).ravel() for a in arrays]
        return Packed(jnp.concatenate(words), (), (tuple((a.shape, a.dtype) for a in arrays), structure))
    apart, shapes, parts = [], [], []
    for leaf in leaves:
        if isinstance(leaf, jax.Array):
            apart.append(leaf)
            shapes.append(((), None))
            continue
        a = leaf if isinstance(leaf, np.ndarray | np.generic) else np.asarray(leaf, jnp.result_type(leaf))
        dtype = jax.dtypes.canonicalize_dtype(a.dtype)
        shapes.append((a.shape, dtype))
        parts.append(a.astype(_stored(dtype), copy=False).tobytes())
    return Packed(np.frombuffer(b"".join(parts), _WORD), tuple(apart), (tuple(shapes), structure))


def unpacked(given: Packed) -> Any:
    """Return the pytree; its packed leaves are NumPy's arrays if the words are one."""
    (shapes, structure), apart, at, leaves = given.form, iter(given.apart), 0, []
    for shape, dtype in shapes:
        if dtype is None:
            leaves.append(next(apart))
            continue
        stored = _stored(dtype)
        each = stored.itemsize // _WORD.itemsize
        words = given.words[at : at + each * math.prod(shape)]
        at += len(words)
        if isinstance(words, np.ndarray):
            leaf = words.view(stored).reshape(shape)
        else:
            leaf = jax.lax.bitcast_convert_type(words.reshape(*shape, *[each] * (each > 1)), stored)
        leaves.append(leaf.astype(dtype))
    return jax.tree.unflatten(structure, leaves)


def _stored(dtype: np.dtype) -> np.dtype:
    """Return the type in which numbers are packed: short ones and flags take a word each."""
    if dtype.itemsize >= _WORD.itemsize:
        return dtype
    return _WORD if dtype.kind in "biu" else np.dtype(np.float32)
