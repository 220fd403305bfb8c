"""Batches by name: which arrays have the batch's axis, and how to make such arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._errors import OsikValueError
from ..robot._model import RobotModel
from ..robot._tree import KinematicTree, ModelHolder
from ._names import find_leaves, leaf_names, replace_named

T = TypeVar("T")


def batch_axes(tree: T, *names: str, axis: int = 0) -> T:
    """Return ``in_axes`` (or ``out_axes``) of ``jax.vmap`` for a pytree: 0 for the named arrays, None for the rest.

    ``jax.vmap(step, in_axes=(0, osik.batch_axes(tasks, "hand.target")))`` maps over configurations and over the hand's
    target, while all else in ``tasks`` is shared.

    Args:
        tree: tasks, a robot, limits, a scheme, or any other pytree; its numbers do not matter.
        names: of what is batched: ``"hand.target"``, ``"hand.gain.maximum"``, ``"[1].velocity"`` (of a tuple of
            limits), ``"body_mass"`` (of a robot). A name stands for all arrays under it, so ``"hand"`` for the whole
            task; ``*`` stands for any part of a name up to a dot: ``"*.weight"``.
        axis: where the batch's axis is.

    Returns:
        A pytree of the same structure, with ``axis`` in the place of each array named and None for the others.

    Raises:
        KeyError: no such name; the message lists the arrays.
    """
    known = leaf_names(tree)
    chosen = {place for name in names for place in find_leaves(known, name)}
    return jax.tree.unflatten(
        jax.tree.structure(tree), [axis if place in chosen else None for place in range(len(known))]
    )


def batched(tree: T, values: Mapping[str, Any]) -> T:
    """Return the pytree with the named arrays replaced by batches of them; map over ``batch_axes(tree, *values)``.

    Args:
        tree: tasks, a robot, limits, a scheme, or any other pytree.
        values: by name, as in ``batch_axes``: arrays with one more axis in front. Of what holds several arrays, such
            as a pose, a pytree of them: ``{"hand.target": (positions (n, 3), rotations (n, 3, 3))}``. (n,) numbers for
            an array of another shape: each is repeated. Signs are not checked, unlike in ``Task.replace``.

    Raises:
        KeyError: no such name; the message lists the arrays.
        ValueError: a wrong shape, different lengths, or an array that is given twice.
    """
    values = {name: _as_array(value) for name, value in values.items()}
    lengths = {name: {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(value)} for name, value in values.items()}
    if len(set().union(*lengths.values())) > 1:
        shown = "; ".join(f"{k}: {', '.join(str(n[0]) if n else 'none' for n in v)}" for k, v in lengths.items())
        raise OsikValueError(f"the lengths of the batch differ: {shown}")
    return replace_named(tree, leaf_names(tree), values, batched=True)


def _as_array(value: Any) -> Any:
    """Return a list of numbers as one array; other pytrees as they are."""
    leaves = jax.tree.leaves(value)
    numbers = isinstance(value, list | tuple) and leaves and not any(jnp.ndim(leaf) for leaf in leaves)
    return jnp.asarray(value) if numbers else value


def stack(items: Iterable[T]) -> T:
    """Return one pytree of stacked arrays from several of the same structure: robots, tasks, limits; ``vmap`` over it.

    A stack of robots of different files has no ``mj_model``, and what is read from it is to be made robot by robot.

    Raises:
        ValueError: there is nothing to stack, or structure differs: the message says what, and why it cannot.
    """
    items = list(items)
    if not items:
        raise OsikValueError("there is nothing to stack")
    for place, item in enumerate(items[1:], 1):
        reason = _difference(items[0], item, "")
        if reason is not None:
            raise OsikValueError(f"item {place} does not stack on item 0: {reason}")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *_with_one_model(items))


def _with_one_model(items: Sequence[T]) -> list[T]:
    """Return the items with robots that share one model holder: theirs if it is equal, else an empty one."""
    flat = [jax.tree.flatten(item, is_leaf=_is_robot) for item in items]
    columns = [_alike(parts) for parts in zip(*(leaves for leaves, _ in flat), strict=True)]
    return [
        structure.unflatten(leaves) for (_, structure), leaves in zip(flat, zip(*columns, strict=True), strict=True)
    ]


def _is_robot(part: Any) -> bool:
    return isinstance(part, RobotModel)


def _alike(parts: Sequence[Any]) -> Sequence[Any]:
    """Return corresponding parts of the items; robots with different models get an empty holder."""
    if not _is_robot(parts[0]) or all(part.holder == parts[0].holder for part in parts):
        return parts
    return [dataclasses.replace(part, holder=ModelHolder(None)) for part in parts]


_PRIORITY = "a priority is structure, for each is a level with shapes of its own; make one batch for each order"
_STRUCTURE = "that is structure, not a number; make one batch for each"


def _difference(a: Any, b: Any, where: str) -> str | None:
    """Return the first difference in the structure of two pytrees, as text for a message; None if there is none."""
    at = where.removeprefix(".") or "it"
    if type(a) is not type(b) and not (_is_number(a) and _is_number(b)):
        return f"{at} is a {type(a).__name__} in one and a {type(b).__name__} in the other; {_STRUCTURE}"
    if isinstance(a, Mapping):
        return _of_keys(a, b, where, at)
    if isinstance(a, (tuple, list)):
        if len(a) != len(b):
            return f"{at} has {len(a)} parts in one and {len(b)} in the other; {_STRUCTURE}"
        return _first(_difference(x, y, f"{where}[{i}]") for i, (x, y) in enumerate(zip(a, b, strict=True)))
    if isinstance(a, eqx.Module):
        fields = dataclasses.fields(a)
        return _first(_of_field(field, a, b, f"{where}.{field.name}") for field in fields)
    if _is_number(a) and jnp.shape(a) != jnp.shape(b):
        return f"{at} has shape {jnp.shape(a)} in one and {jnp.shape(b)} in the other"
    return None


def _first(reasons: Any) -> str | None:
    return next((reason for reason in reasons if reason is not None), None)


def _of_keys(a: Mapping[Any, Any], b: Mapping[Any, Any], where: str, at: str) -> str | None:
    if set(a) != set(b):
        only = ", ".join(repr(key) for key in sorted(set(a) ^ set(b), key=str))
        return f"{at} has other names in one than in the other ({only}); {_STRUCTURE}"
    return _first(_difference(a[key], b[key], f"{where}.{key}") for key in a)


def _of_field(field: Any, a: Any, b: Any, where: str) -> str | None:
    old, new = getattr(a, field.name), getattr(b, field.name)
    if not field.metadata.get("static"):
        return _difference(old, new, where)
    if isinstance(old, ModelHolder) or old == new:
        return None
    name = where.removeprefix(".")
    if isinstance(old, KinematicTree):
        return f"the robots' {_of_trees(old, new)} differ, and only lengths, masses and limits may"
    return f"{name} is {old!r} in one and {new!r} in the other; {_PRIORITY if field.name == 'priority' else _STRUCTURE}"


def _of_trees(a: KinematicTree, b: KinematicTree) -> str:
    names = (field.name for field in dataclasses.fields(a))
    return " and ".join(name.replace("_", " ") for name in names if getattr(a, name) != getattr(b, name))


def _is_number(value: Any) -> bool:
    return eqx.is_array_like(value)
