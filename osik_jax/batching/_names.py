"""The numbers of a pytree by name: ``hand.weight``, ``hand.gain.maximum``, ``[1].velocity``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._errors import OsikValueError, unknown_name

T = TypeVar("T")


def leaf_names(tree: Any) -> tuple[str, ...]:
    """Return each leaf's name, in JAX's order: attributes and keys after a dot, places in a sequence in brackets."""
    return tuple(_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree))


def _name(path: Sequence[Any]) -> str:
    parts = [f"[{key.idx}]" if isinstance(key, jax.tree_util.SequenceKey) else f".{_label(key)}" for key in path]
    return "".join(parts).removeprefix(".")


def _label(key: Any) -> Any:
    return key.name if isinstance(key, jax.tree_util.GetAttrKey) else key.key


def find_leaves(names: Sequence[str], wanted: str) -> tuple[int, ...]:
    """Return the indices of the leaf called ``wanted``, or of all leaves under it.

    A ``*`` stands for any part of a name up to the next dot: ``*.weight``, ``*_foot.gain``, ``limits[*].velocity``.
    """
    own = "[^.]*".join(re.escape(part) for part in str(wanted).split("*"))
    pattern = re.compile(rf"{own}(?:[.\[].*)?")
    found = tuple(place for place, name in enumerate(names) if pattern.fullmatch(name))
    if not found:
        raise unknown_name("number", wanted, tuple(names))
    return found


def replace_named(tree: T, names: Sequence[str], values: Mapping[str, Any], *, batched: bool = False) -> T:
    """Return the tree with other numbers in its named leaves.

    A value is one array for each of the leaves found (``find_leaves``), or a pytree with one array for each. If
    ``batched``, each has one more axis in front.
    """
    leaves, structure = jax.tree.flatten(tree)
    given: dict[int, str] = {}
    for name, value in values.items():
        for place, new in _paired(names, name, value):
            if place in given:
                raise OsikValueError(f"{names[place]} is given twice, by {given[place]!r} and by {name!r}")
            given[place] = name
            leaves[place] = _fitting(new, leaves[place], names[place], batched)
    return jax.tree.unflatten(structure, leaves)


def _paired(names: Sequence[str], name: str, value: Any) -> list[tuple[int, Any]]:
    """Return the leaves that a name finds, each with its value."""
    places, new = find_leaves(names, name), jax.tree.leaves(value)
    if len(new) not in (1, len(places)):
        found = ", ".join(names[place] for place in places)
        raise OsikValueError(f"{name!r} stands for {len(places)} arrays ({found}), but {len(new)} are given")
    return list(zip(places, new * len(places) if len(new) == 1 else new, strict=True))


def _fitting(value: Any, leaf: Any, name: str, batched: bool) -> Array:
    """Return a new value in the precision of the old leaf, floats for an integer as they are; a scalar is repeated."""
    kind, shape = jnp.result_type(leaf), jnp.shape(leaf)
    new = jnp.asarray(value)
    if not (jnp.issubdtype(kind, jnp.integer) and jnp.issubdtype(new.dtype, jnp.floating)):
        new = jnp.asarray(new, kind)
    lanes = new.shape[:1] if batched else ()
    if batched and new.ndim == 0:
        raise OsikValueError(f"{name} is one number; it needs an axis in front, the batch")
    if new.shape[len(lanes) :] not in ((), shape):
        expected = f"{shape} with an axis in front, the batch" if batched else f"{shape} or a scalar"
        raise OsikValueError(f"{name} has shape {new.shape}, expected {expected}")
    if new.shape != (*lanes, *shape):
        new = new.reshape(*lanes, *[1] * len(shape))
    return jnp.broadcast_to(new, (*lanes, *shape))
