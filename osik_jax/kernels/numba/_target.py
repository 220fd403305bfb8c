"""Calls of kernels from JAX: compiled at the first call, kept on disk, registered with XLA for CPUs.

Nothing here imports Numba before a kernel is asked for.
"""

from __future__ import annotations

import ctypes
import hashlib
import threading
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from inspect import unwrap
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

_registered: dict[str, Any] = {}  # name of the target: the compiled function, which has to stay alive
_lock = threading.Lock()


def call(module: str, outputs: Sequence[tuple[tuple[int, ...], Any]], *inputs: Any) -> list[Array]:
    """Call a kernel on a batch of problems.

    A kernel has no rule for ``vmap``: call it in a function under ``in_lanes``, which hands it a whole batch at once.

    Args:
        module: of this folder, with a function ``handle(frame)``, which XLA calls.
        outputs: shape and type of each result: float (double precision in the kernel) or int (int32).
        inputs: arrays; floats are passed in double precision, integers and flags as int32.

    Returns:
        The results; floats in the precision of the first float among the inputs.
    """
    name = register(module)
    given = next(a.dtype for a in map(jnp.asarray, inputs) if jnp.issubdtype(a.dtype, jnp.floating))
    with jax.enable_x64(True):
        wide = [a.astype(_kind(jnp.asarray(a).dtype)) for a in map(jnp.asarray, inputs)]
        shapes = [jax.ShapeDtypeStruct(shape, _kind(jnp.dtype(kind))) for shape, kind in outputs]
        results = jax.ffi.ffi_call(name, shapes)(*wide)
        return [a.astype(given) if a.dtype == jnp.float64 else a for a in results]


def _kind(dtype: Any) -> Any:
    return jnp.float64 if jnp.issubdtype(dtype, jnp.floating) else jnp.int32


def register(module: str) -> str:
    """Compile a kernel, or load it from disk, and make it known to XLA under the name that is returned; once."""
    name = f"osik_jax{module}"
    with _lock:
        if name not in _registered:
            handler = _load(import_module(f"{__package__}.{module}").handle)
            make = ctypes.pythonapi.PyCapsule_New
            make.restype, make.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
            jax.ffi.register_ffi_target(name, make(handler.address, None, None), platform="cpu")
            _registered[name] = handler
    return name


def _load(handle: Any) -> Any:
    """Return the function as compiled code, from disk where it has been compiled before (``cache_folder``).

    Where that folder cannot be written, Numba takes the one beside the source; where no folder can be, or what is in it
    cannot be read, the process compiles for itself.
    """
    numba = import_module("numba")
    compiler = partial(numba.cfunc, "int64(int64)", error_model="numpy")
    handle = unwrap(handle)
    folder, before = cache_folder(), numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = folder
        return compiler(cache=True)(handle)
    except Exception:  # of the cache: what is wrong with the function is wrong below too
        return compiler()(handle)
    finally:
        numba.config.CACHE_DIR = before


def cache_folder() -> str:
    """Return the folder for compiled kernels: one for each state of the kernels' sources and of Numba's switches.

    It is in ``NUMBA_CACHE_DIR`` or, without that, in the user's folder for caches. Numba itself looks at nothing but
    the time of the file that has ``handle``, and at its own version and the processor.
    """
    config = import_module("numba").config
    appdirs = import_module("numba.misc.appdirs")
    key = hashlib.sha256(repr((config.BOUNDSCHECK, str(config.OPT))).encode())
    package = Path(__file__).parents[2]
    # kernels have the constants that they share with plain methods compiled in
    sources = [*sorted((package / "kernels").rglob("*.py")), package / "numerics" / "_constants.py"]
    for path in sources:
        key.update(path.read_bytes())
    return str(Path(config.CACHE_DIR or appdirs.user_cache_dir("osik_jax", appauthor=False)) / key.hexdigest()[:16])
