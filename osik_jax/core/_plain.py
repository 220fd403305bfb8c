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


@cache
def functions() -> Functions:
    """Return the functions of this process's core, which has to be there.

    They keep Python's lock: a step is shorter than what giving it away costs.
    """
    library, pointer, number = ctypes.PyDLL(str(_library.core().path)), ctypes.c_void_p, ctypes.c_int
    library.osik_plain_new.argtypes = [pointer, number]
    library.osik_plain_new.restype = pointer
    library.osik_plain_free.argtypes = [pointer]
    library.osik_plain_free.restype = None
    library.osik_plain_step.argtypes = [pointer] * 5 + [number] + [pointer] * 2
    library.osik_plain_step.restype = None
    library.osik_plain_integrate.argtypes = [number] * 2 + [pointer] * 5
    library.osik_plain_integrate.restype = None
    library.osik_plain_rows_new.argtypes = [pointer] * 2 + [number]
    library.osik_plain_rows_new.restype = pointer
    library.osik_plain_rows_free.argtypes = [pointer]
    library.osik_plain_rows_free.restype = None
    library.osik_plain_rows_set.argtypes = [pointer] * 3
    library.osik_plain_rows_set.restype = None
    library.osik_plain_rows.argtypes = [pointer] * 5
    library.osik_plain_rows.restype = None
    return Functions(
        library.osik_plain_new,
        library.osik_plain_free,
        library.osik_plain_step,
        library.osik_plain_integrate,
        library.osik_plain_rows_new,
        library.osik_plain_rows_free,
        library.osik_plain_rows_set,
        library.osik_plain_rows,
    )
