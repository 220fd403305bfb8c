"""Placeholders: NaN is replaced before the first operation, and a flag records that it was there.

A select at the end keeps a NaN out of an answer but not out of a derivative. Reverse mode multiplies the zero from the
select by coefficients that are NaN, and the sum over lanes carries that into every shared number.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

_WEIGHTS = {"weight", "position_weight", "orientation_weight", "gain"}
_NEVER_INFINITE = _WEIGHTS | {"target", "target_velocity", "axis", "ratios"}
"""Fields of a task that bound nothing."""


def with_placeholder(tree: Any) -> tuple[Any, Bool[Array, ""]]:
    """Return the tree with 1 in place of numbers that are not valid, and whether all were valid.

    Each array is checked by itself, so an array that all lanes share stays shared. NaN is never valid. An infinity is
    valid if it can mean "no bound", so not in a bare array, nor in the weights, gain and target of a task.
    """
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    valid = jax.tree_util.tree_map_with_path(lambda path, a: jnp.where(_is_invalid(path, a), 1.0, a), numbers)
    kinds: dict[bool, list[Array]] = {True: [], False: []}
    for path, leaf in jax.tree_util.tree_leaves_with_path(numbers):
        kinds[never_infinite(path)].append(jnp.ravel(jax.lax.stop_gradient(leaf)))
    flags = [~jnp.isnan(_joined(kinds[False])).any(), jnp.isfinite(_joined(kinds[True])).all()]
    return eqx.combine(valid, rest), flags[0] & flags[1]


def positive(dt: Any) -> Array:
    """Return dt, or NaN unless it is positive."""
    dt = jnp.asarray(dt)
    return jnp.where(dt > 0.0, dt, jnp.nan)


def _joined(arrays: list[Array]) -> Array:
    """Return all numbers as one array, so that one operation checks them."""
    return jnp.concatenate(arrays) if arrays else jnp.zeros(0)


def _is_invalid(path: tuple[Any, ...], leaf: Array) -> Bool[Array, "..."]:
    return ~jnp.isfinite(leaf) if never_infinite(path) else jnp.isnan(leaf)


def never_infinite(path: tuple[Any, ...]) -> bool:
    names = {key.name for key in path if isinstance(key, jax.tree_util.GetAttrKey)}
    return not names or bool(names & _NEVER_INFINITE)
