"""Methods of Equinox modules that plain loops call."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast

_Method = TypeVar("_Method")


def quick_method(method: _Method) -> _Method:
    """Decorate a method so that a call takes Python's time.

    A module makes a new module of each method that it is asked for, so that the method is a pytree. That takes as long
    as a control step. A decorated method is a function that holds its module, and no pytree.
    """
    return cast(_Method, _Quick(cast(Any, method)))


class _Quick:
    def __init__(self, method: Callable[..., Any]) -> None:
        self.method, self.__doc__, self.__wrapped__ = method, method.__doc__, method

    def __get__(self, own: Any, owner: type) -> Callable[..., Any]:
        return self.method if own is None else partial(self.method, own)
