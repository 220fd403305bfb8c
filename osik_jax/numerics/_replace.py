"""Base class of immutable objects (tasks, limits, schemes) whose numbers can be replaced, by a quick method."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Self, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp

from .._errors import OsikTypeError
from ._arguments import as_vector
from ._host import to_jax

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


class Replaceable(eqx.Module):
    """Base of immutable objects: their numbers can be replaced, their structure cannot."""

    @quick_method
    def replace(self, **changes: Any) -> Self:
        """Return a copy of the object with other numbers, checked and converted as on construction.

        Works inside ``jit`` and changes no structure, so nothing is compiled again:
        ``task.replace(target=(p, R), gain=5.0)``, ``limit.replace(gain=0.5)``, ``scheme.replace(damping=1e-4)``. A
        batch is a vmapped replace: ``jax.vmap(lambda p: task.replace(target=(p, R)))(positions)``.

        Raises:
            TypeError: a name is not one of this object's numbers; the message lists them.
            ValueError: a wrong shape or value.
        """
        known = self.replaceable
        for name in changes:
            if name not in known:
                raise OsikTypeError(
                    f"{type(self).__name__} has no {name!r} to replace; "
                    f"it has: {', '.join(known)} (structure is fixed at construction)"
                )
        if not changes:
            return self
        new = object.__new__(type(self))  # ``equinox.tree_at`` takes the time of ten control steps
        vars(new).update(vars(self))
        kind = type(self)
        for name, value in changes.items():
            vars(new)[name] = jax.tree.map(to_jax, kind._convert(self, name, value))
        kind._check(new)
        return new

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts: the fields with numbers."""
        return tuple(name for name in _replaceable(type(self)) if vars(self)[name] is not None)

    def _convert(self, name: str, value: Any) -> Any:
        """Return the new value of a field, in the precision of the old one."""
        old = getattr(self, name)
        return as_vector(value, jnp.shape(old), name, jnp.result_type(old, float))

    def _check(self) -> None:
        """Raise ValueError if a number is out of its range, or if fields do not fit each other."""


@cache
def _replaceable(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind) if not field.metadata.get("static"))
