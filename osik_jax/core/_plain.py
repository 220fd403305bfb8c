"""Functions of the core that Python calls by itself, without XLA (``plain_step_cpu.cpp``)."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any, NamedTuple

from . import _library


class Functions(NamedTuple):
    """Functions with their types; arrays are given by their addresses."""

    new: Any
    free: Any
    step: Any
    integrate: Any
    rows_new: Any
    rows_free: Any
    rows_set: Any
    rows: Any


_POINTER, _NUMBER = ctypes.c_void_p, ctypes.c_int
_TYPES: dict[str, tuple[Any, list[Any]]] = {
    "new": (_POINTER, [_POINTER, _NUMBER]),
    "free": (None, [_POINTER]),
    "step": (None, [_POINTER] * 5 + [_NUMBER] + [_POINTER] * 2),
    "integrate": (None, [_NUMBER] * 2 + [_POINTER] * 5),
    "rows_new": (_POINTER, [_POINTER] * 2 + [_NUMBER]),
    "rows_free": (None, [_POINTER]),
    "rows_set": (None, [_POINTER] * 3),
    "rows": (None, [_POINTER] * 5),
}
"""Type of each function's result, and of its arguments."""


@cache
def functions() -> Functions:
    """Return the functions of this process's core, which has to be there.

    They keep Python's lock: a step is shorter than what giving it away costs.
    """
    library = ctypes.PyDLL(str(_library.core().path))
    found = Functions(*(getattr(library, f"osik_plain_{name}") for name in Functions._fields))
    for name, function in zip(Functions._fields, found, strict=True):
        function.restype, function.argtypes = _TYPES[name]
    return found
