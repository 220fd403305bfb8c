"""Tasks, limits and schemes as data that JSON holds, field by field and to the last bit."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import importlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import OsikValueError
from ..limits import NoLimits, no_limits

_PACKAGE = "osik_jax."


def encode(value: Any, where: str) -> Any:
    """Return the value as data for JSON.

    Args:
        value: a task, limit, scheme or what their fields hold.
        where: name of the value, for messages.

    Raises:
        ValueError: an object of a class that is not in osik_jax, such as a function or a task of your own.
    """
    if isinstance(value, enum.Enum):
        return {"class": _name(type(value), where), "value": value.value}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        return {
            "array": array.tolist(),
            "dtype": str(array.dtype),
            "of": "jax" if isinstance(value, jax.Array) else "numpy",
        }
    if isinstance(value, Mapping):
        return {"mapping": [[encode(key, where), encode(one, f"{where}[{key!r}]")] for key, one in value.items()]}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: encode(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
        return {"class": _name(type(value), where), "fields": fields}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        fields = {name: encode(getattr(value, name), f"{where}.{name}") for name in value._fields}  # pyright: ignore
        return {"class": _name(type(value), where), "fields": fields}
    if isinstance(value, tuple | list | frozenset):
        kind = type(value).__name__
        return {"sequence": kind, "items": [encode(one, f"{where}[{k}]") for k, one in enumerate(value)]}
    raise OsikValueError(
        f"{where} is a {type(value).__name__}, which a file cannot hold: it holds classes of osik_jax and numbers"
    )


def decode(data: Any) -> Any:
    """Return the value of what ``encode`` returned.

    Raises:
        ValueError: no such data, or a class or field that this version does not have.
    """
    if not isinstance(data, Mapping):
        return data
    if "array" in data:
        array = np.asarray(data["array"], data["dtype"])
        return jnp.asarray(array) if data["of"] == "jax" else array
    if "mapping" in data:
        return {decode(key): decode(one) for key, one in data["mapping"]}
    if "sequence" in data:
        return {"tuple": tuple, "list": list, "frozenset": frozenset}[data["sequence"]](map(decode, data["items"]))
    cls = _class(data["class"])
    if "value" in data:
        return cls(data["value"])
    return _made(cls, {name: decode(one) for name, one in data["fields"].items()})


def _made(cls: Any, fields: dict[str, Any]) -> Any:
    """Return an object of a class with these fields, without its constructor."""
    known = getattr(cls, "_fields", ()) if issubclass(cls, tuple) else [f.name for f in dataclasses.fields(cls)]
    if cls is NoLimits:
        return no_limits
    if set(known) != set(fields):
        raise OsikValueError(f"a {cls.__name__} of this version has the fields {sorted(known)}, not {sorted(fields)}")
    if issubclass(cls, tuple):
        return cls(**fields)
    made = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def _name(cls: type, where: str) -> str:
    """Return where a class is found; a class of osik_jax alone."""
    if not cls.__module__.startswith(_PACKAGE):
        raise OsikValueError(
            f"{where} is a {cls.__name__}, which is no class of osik_jax: a file cannot hold it. Make it again after "
            "loading, and add it to the tasks or limits"
        )
    return f"{cls.__module__}.{cls.__qualname__}"


def _class(name: str) -> Any:
    module, _, own = name.rpartition(".")
    found = None
    if module.startswith(_PACKAGE):
        with contextlib.suppress(ImportError):
            found = getattr(importlib.import_module(module), own, None)
    if not isinstance(found, type) or not (dataclasses.is_dataclass(found) or issubclass(found, tuple | enum.Enum)):
        raise OsikValueError(f"{name!r} is no class of this version of osik_jax")
    return found
