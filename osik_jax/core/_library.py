"""The compiled core: choice of the library, and calls of its methods from JAX."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._errors import warn
from . import _build

_REMEDY = "install a C++ compiler (Debian: g++, macOS: xcode-select --install) and install osik_jax again"
_REBUILD = "python -m osik_jax.core._build builds it again"
_registered: set[str] = set()
Shapes = list[tuple[tuple[int, ...], Any]]
"""Shape and type of each result of a kernel."""
_lock = threading.Lock()


class Core(NamedTuple):
    """Compiled core of this process: its library, or the reason for its absence."""

    library: ctypes.CDLL | None  # the library, None where there is none
    path: Path | None  # its file, None where there is none
    reason: str  # one sentence that says which library is loaded and why, or why none is and what to do


@cache
def core() -> Core:
    """Return the core for this processor.

    ``OSIK_CORE_LIBRARY`` selects another library file, or "none".
    """
    named = os.environ.get("OSIK_CORE_LIBRARY")
    if named == "none":
        return Core(None, None, "the core is switched off by OSIK_CORE_LIBRARY=none")
    if named:
        return Core(ctypes.CDLL(named), Path(named), f"the core is {named}, as OSIK_CORE_LIBRARY says")
    reasons, remedy = [], _REMEDY
    for level in reversed(_build.levels()):  # the one that runs everywhere tells what the processor can do
        path = _build.library_path(level)
        try:
            library = ctypes.CDLL(str(path))
        except OSError as problem:
            reasons.append(f"{problem}" if path.exists() else f"{path.name} was not built")
            continue
        library.osik_sources.restype = ctypes.c_char_p
        if library.osik_sources().decode() != _build.fingerprint():
            reasons.append(f"{path.name} was built from other sources")
            remedy = _REBUILD
            continue
        if level == "x86_64" and library.osik_has_x86_64_v3():
            fast = _build.library_path("x86_64_v3")
            if fast.exists():
                return Core(ctypes.CDLL(str(fast)), fast, f"{fast.name}: this processor has AVX2 and FMA")
        return Core(library, path, f"{path.name}: the instruction set {level}")
    slower = "Methods run in plain JAX: the answers are the same, and come more slowly"
    return Core(None, None, f"no compiled core: {'; '.join(reasons)}. {slower}; {remedy}")


def installed() -> bool:
    """Return whether the compiled core is installed; warn once, with the remedy, if it is not."""
    if core().library is None:
        _warn_once()
        return False
    return True


@cache
def _warn_once() -> None:
    if os.environ.get("OSIK_CORE_LIBRARY") != "none":
        warn(core().reason)


def call(method: str, outputs: Sequence[tuple[tuple[int, ...], Any]], *inputs: Any, space: int = 0) -> list[Array]:
    """Call a method of the core on a batch of problems through XLA's FFI.

    There is no rule for ``vmap``: call it in a function under ``in_lanes``, which hands over a whole batch at once.
    ``method`` is its handler without "osik_". Results are float (double precision in the core) or int (int32); inputs
    are passed in double precision, integers and flags as int32. Floats come back in the precision of the first float
    among the inputs. ``space`` is in numbers, for methods of ``core/kinematic_calls.hpp``.
    """
    name = register(method)
    given = next(a.dtype for a in map(jnp.asarray, inputs) if jnp.issubdtype(a.dtype, jnp.floating))
    with jax.enable_x64(True):
        wide = [a.astype(_kind(jnp.asarray(a).dtype)) for a in map(jnp.asarray, inputs)]
        shapes = [jax.ShapeDtypeStruct(shape, _kind(jnp.dtype(kind))) for shape, kind in outputs]
        results = jax.ffi.ffi_call(name, shapes)(*wide, **({"space": np.int32(space)} if space else {}))
        return [a.astype(given) if a.dtype == jnp.float64 else a for a in results]


def shapes_of(
    lanes: int, numbers: Sequence[tuple[int, ...]], integers: Sequence[tuple[int, ...]], real: Any = jnp.float64
) -> Shapes:
    """Return shape and type of results: arrays of numbers, then of integers, with a leading axis of lanes."""
    return [((lanes, *shape), kind) for kind, shapes in ((real, numbers), (jnp.int32, integers)) for shape in shapes]


def register(method: str) -> str:
    """Register a method's handler with XLA for CPUs; return its name there."""
    name = f"osik_{method}"
    with _lock:
        if name not in _registered:
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(core().library, name)), platform="cpu")
            _registered.add(name)
    return name


def _kind(dtype: Any) -> Any:
    return jnp.float64 if jnp.issubdtype(dtype, jnp.floating) else jnp.int32
