"""Base class of immutable objects (tasks, limits, schemes) whose numbers can be replaced."""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp

from .._errors import OsikTypeError
from ._arguments import as_vector


class Replaceable(eqx.Module):
    """Base of immutable objects: their numbers can be replaced, their structure cannot."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy of the object with other numbers, checked and converted as on construction.

        Works inside ``jit`` and changes no structure, so nothing is compiled again:
        ``task.replace(target=(p, R), gain=5.0)``, ``limit.replace(gain=0.5)``, ``scheme.replace(damping=1e-4)``. A
        batch is a vmapped replace: ``jax.vmap(lambda p: task.replace(target=(p, R)))(positions)``.

        Raises:
            TypeError: a name is not one of this object's numbers; the message lists them.
            ValueError: a wrong shape or value.
        """
        for name in changes:
            if name not in self.replaceable:
                raise OsikTypeError(
                    f"{type(self).__name__} has no {name!r} to replace; "
                    f"it has: {', '.join(self.replaceable)} (structure is fixed at construction)"
                )
        names = tuple(changes)
        values = [self._convert(name, value) for name, value in changes.items()]
        if not names:
            return self
        new = eqx.tree_at(lambda own: [getattr(own, name) for name in names], self, values)
        new._check()
        return new

    @property
    def replaceable(self) -> tuple[str, ...]:
        """Return the names that ``replace`` accepts: the fields with numbers."""
        fields = dataclasses.fields(self)
        return tuple(f.name for f in fields if not f.metadata.get("static") and getattr(self, f.name) is not None)

    def _convert(self, name: str, value: Any) -> Any:
        """Return the new value of a field, in the precision of the old one."""
        old = getattr(self, name)
        return as_vector(value, jnp.shape(old), name, jnp.result_type(old, float))

    def _check(self) -> None:
        """Raise ValueError if a number is out of its range, or if fields do not fit each other."""
