"""Split of a pytree into its numbers, which are traced, and its static structure."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

Static = tuple[tuple[Any, ...], Any]
"""Leaves that are no numbers, and the structure that they stand in; hashable."""


def is_number(leaf: Any) -> bool:
    """Return whether a leaf is a number (array, tracer or Python float) and not structure."""
    return eqx.is_array(leaf) or isinstance(leaf, float | np.ndarray | np.generic)


def taken_apart(tree: Any) -> tuple[Any, Static]:
    """Return the numbers (a pytree with None for other leaves), and the structure as a static argument of ``jit``."""
    numbers, structure = eqx.partition(tree, is_number)
    leaves, treedef = jax.tree.flatten(structure)
    return numbers, (tuple(leaves), treedef)


def put_together(numbers: Any, static: Static) -> Any:
    """Return the pytree that ``taken_apart`` took apart."""
    return eqx.combine(numbers, jax.tree.unflatten(static[1], static[0]))
