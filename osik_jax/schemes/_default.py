"""Default scheme of a call without ``scheme=``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax

from ..tasks import Task
from ._hierarchical import HierarchicalQP
from ._scheme import Scheme
from ._weighted import WeightedQP


def scheme_for(tasks: Mapping[str, Task], dtype: Any) -> Scheme:
    """Return ``HierarchicalQP()`` if priorities differ among the tasks that are not hard, else ``WeightedQP()``.

    Its numbers have the given dtype.
    """
    chosen = HierarchicalQP() if len(priorities(tasks)) > 1 else WeightedQP()
    return jax.tree.map(lambda leaf: leaf.astype(dtype), chosen)


def priorities(tasks: Mapping[str, Task]) -> set[int]:
    """Return the priorities of the tasks that are not hard; a hard task stands above every priority."""
    return {task.priority for task in tasks.values() if not task.hard}
