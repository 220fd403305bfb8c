"""Results for objects that a program is called with again and again, found by identity."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any

from ._host import is_traced

_MOST = 32
"""Results that are kept; each keeps its arguments, too, so that no other object has their place in memory."""


def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its last results kept, for the same positional objects and equal keyword arguments.

    The positional arguments are compared by identity: flattening a robot costs more than a search. They must not be
    changed in place. Keyword arguments are hashable. A result that is None, or made while tracing, is not kept.
    """
    kept: OrderedDict[Any, tuple[tuple[Any, ...], Any]] = OrderedDict()

    @wraps(function)
    def call(*objects: Any, **static: Any) -> Any:
        key = (*map(id, objects), *static.items())
        found = kept.get(key)
        if found is not None:
            return found[1]
        result = function(*objects, **static)
        if result is not None and not is_traced(result):
            kept[key] = objects, result
            while len(kept) > _MOST:
                kept.popitem(last=False)
        return result

    return call


@remembered
def hold_numbers(*objects: Any) -> bool | None:
    """Return True if no number of the objects is traced, else None."""
    return None if is_traced(objects) else True
