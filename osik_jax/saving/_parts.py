"""Tasks, limits and schemes as JSON data, field by field and to the last bit."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import importlib
import sys
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import OsikValueError
from ..limits import NoLimits, no_limits
from ..numerics._replace import Replaceable
from ..robot._tree import KinematicTree

_PACKAGE = "osik_jax."
_NUMBERED = {"joint": "joint_names", "joints": "joint_names", "bodies": "body_names", "frames": "frame_names"}
"""Fields that number parts of a robot, and where its tree has their names. A file has the names: the robot that is
read from it may number its parts in another order."""


def encode(value: Any, where: str, tree: KinematicTree) -> Any:
    """Return the value as data for JSON.

    Args:
        value: a task, limit, scheme or what their fields hold.
        where: name of the value, for messages.
        tree: of the robot that the value was made for.

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
            "shape": array.shape,  # which the list does not tell of an array without entries
            "dtype": str(array.dtype),
            "of": "jax" if isinstance(value, jax.Array) else "numpy",
        }
    if isinstance(value, Mapping):
        pairs = [[encode(key, where, tree), encode(one, f"{where}[{key!r}]", tree)] for key, one in value.items()]
        return {"mapping": pairs}
    if (names := _field_names(type(value))) is not None:
        fields = {name: _field(name, getattr(value, name), f"{where}.{name}", tree) for name in names}
        return {"class": _name(type(value), where), "fields": fields}
    if isinstance(value, tuple | list | frozenset):
        kind = type(value).__name__
        return {"sequence": kind, "items": [encode(one, f"{where}[{k}]", tree) for k, one in enumerate(value)]}
    raise OsikValueError(
        f"{where} is a {type(value).__name__}, which a file cannot hold: it holds classes of osik_jax and numbers"
    )


def _field_names(cls: type) -> tuple[str, ...] | None:
    """Return the names of the fields of a dataclass or named tuple, None for other classes."""
    if dataclasses.is_dataclass(cls):
        return tuple(field.name for field in dataclasses.fields(cls))
    return getattr(cls, "_fields", None) if issubclass(cls, tuple) else None


def _field(name: str, value: Any, where: str, tree: KinematicTree) -> Any:
    numbers = value if isinstance(value, tuple) else (value,)
    if name not in _NUMBERED or not all(type(number) is int for number in numbers):
        return encode(value, where, tree)
    names = [getattr(tree, _NUMBERED[name])[number] for number in numbers]
    return {"names": _NUMBERED[name], "of": names if isinstance(value, tuple) else names[0]}


def decode(data: Any, tree: KinematicTree) -> Any:
    """Return the value of data from ``encode``, for the robot with this tree.

    Raises:
        ValueError: no such data, a class or field that this version does not have, or a name that the robot has not.
    """
    if not isinstance(data, Mapping):
        return data
    if "array" in data:
        array = np.asarray(data["array"], data["dtype"]).reshape(data["shape"])
        return jnp.asarray(array) if data["of"] == "jax" else array
    if "mapping" in data:
        return {decode(key, tree): decode(one, tree) for key, one in data["mapping"]}
    if "sequence" in data:
        items = [decode(one, tree) for one in data["items"]]
        return {"tuple": tuple, "list": list, "frozenset": frozenset}[data["sequence"]](items)
    if "names" in data:
        names, of = getattr(tree, data["names"]), data["of"]
        for name in [of] if isinstance(of, str) else of:
            if name not in names:
                raise OsikValueError(f"the robot has no {name!r} in its {data['names']}")
        return names.index(of) if isinstance(of, str) else tuple(map(names.index, of))
    cls = _class(data["class"])
    if "value" in data:
        return cls(data["value"])
    return _made(cls, {name: decode(one, tree) for name, one in data["fields"].items()})


def _made(cls: Any, fields: dict[str, Any]) -> Any:
    """Return an object of a class with these fields, without its constructor."""
    if cls is NoLimits:
        return no_limits
    known = _field_names(cls) or ()
    if set(known) != set(fields):
        raise OsikValueError(f"a {cls.__name__} of this version has the fields {sorted(known)}, not {sorted(fields)}")
    if issubclass(cls, tuple):
        return cls(**fields)
    made = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    if isinstance(made, Replaceable):  # raises for numbers that the constructor would refuse
        made.replace(**{name: getattr(made, name) for name in made.replaceable})
    return made


def _name(cls: type, where: str) -> str:
    """Return the name of a class of osik_jax, the public one where it has one; raise for other classes.

    Modules are private and may change their places: a public name stays.
    """
    if not cls.__module__.startswith(_PACKAGE):
        raise OsikValueError(
            f"{where} is a {cls.__name__}, which is no class of osik_jax: a file cannot hold it. Make it again after "
            "loading, and add it to the tasks or limits"
        )
    public = getattr(sys.modules[_PACKAGE[:-1]], cls.__name__, None) is cls
    return f"{_PACKAGE}{cls.__name__}" if public else f"{cls.__module__}.{cls.__qualname__}"


def _class(name: str) -> Any:
    module, _, own = name.rpartition(".")
    found = None
    if f"{module}.".startswith(_PACKAGE):
        with contextlib.suppress(ImportError):
            found = getattr(importlib.import_module(module), own, None)
    if not isinstance(found, type) or not (dataclasses.is_dataclass(found) or issubclass(found, tuple | enum.Enum)):
        raise OsikValueError(f"{name!r} is no class of this version of osik_jax")
    return found
