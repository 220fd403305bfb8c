"""What XLA hands to a kernel: the call frame of its foreign function interface (FFI), read from inside Numba.

The offsets are those of ``xla/ffi/api/c_api.h`` (``jax.ffi.include_dir()``) on 64-bit machines, the same in all
releases that pyproject.toml allows (jax 0.8 to 0.12, minor versions 1 to 5 of the interface). Every structure starts
with its size and a pointer to an extension.

    XLA_FFI_CallFrame           extension 8, api 16, stage 32, arguments 72, results 112 (arrays of pointers to buffers)
    XLA_FFI_Buffer              data 24, rank 32, dims 40
    XLA_FFI_Api                 its version: major 32, minor 36
    XLA_FFI_Metadata_Extension  type 8, metadata 24
    XLA_FFI_Metadata            version: major 24, minor 28; traits 32
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import unwrap
from typing import Any, cast

import numba
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

Function = Callable[..., Any]


def compiled(function: Function | None = None, **options: Any) -> Any:
    """Compile a kernel's function, which only other such functions can call; ``py_func`` is the one as written.

    Divisions by 0 are those of NumPy: nothing is raised. Without what Python would need to call them, they take a third
    less time to compile. What an import hook puts around them, as one that checks types does, is taken off.
    """
    if function is None:
        return partial(compiled, **options)
    options |= dict(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
    return cast(Any, numba.njit)(**options)(unwrap(function))


lean = partial(compiled, _nrt=False)
"""Compile a function that makes no array: references are not counted, else as ``compiled``."""

_METADATA = 1  # XLA_FFI_Extension_Metadata
_EXECUTE = 3  # XLA_FFI_ExecutionStage_EXECUTE
_OLDEST = 1  # minor version of an XLA that does not say which one it is: 0.1


def _pointer(typing_context, address, dtype):
    """Return a pointer to numbers of a type at an integer address."""
    pointer = types.CPointer(dtype.dtype)

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(pointer))

    return pointer(types.int64, dtype), generate


_at: Any = intrinsic(_pointer)


@compiled(inline="always")
def _word(address):
    return _at(address, types.int64)[0]


@compiled
def is_call(frame):
    """Return whether XLA wants the kernel to run; its question which version of the interface this is is answered here.

    The answer is the version that XLA itself has: what is read here is the same in all of them.
    """
    extension = _word(frame + 8)
    if extension != 0 and _at(extension + 8, types.int32)[0] == _METADATA:
        api, metadata = _word(frame + 16), _word(extension + 24)
        _at(metadata + 24, types.int32)[0] = 0
        _at(metadata + 28, types.int32)[0] = _at(api + 36, types.int32)[0] if api != 0 else _OLDEST
        _at(metadata + 32, types.int32)[0] = 0
        return False
    return _at(frame + 32, types.int32)[0] == _EXECUTE


@compiled
def arguments(frame):
    """Return the address of the list of a call's arguments."""
    return _word(frame + 72)


@compiled
def results(frame):
    """Return the address of the list of a call's results."""
    return _word(frame + 112)


@compiled
def size(buffers, k, axis):
    """Return the length of an axis of the k-th buffer; axes count from the end where negative."""
    buffer = _word(buffers + 8 * k)
    rank = _word(buffer + 32)
    return _word(_word(buffer + 40) + 8 * (axis if axis >= 0 else rank + axis))


@compiled
def _count(buffer):
    count = 1
    for axis in range(_word(buffer + 32)):
        count *= _word(_word(buffer + 40) + 8 * axis)
    return count


@compiled
def doubles(buffers, k, rows):
    """Return the k-th buffer as an array of float64 with so many rows, without a copy."""
    buffer = _word(buffers + 8 * k)
    return carray(_at(_word(buffer + 24), types.float64), (rows, _count(buffer) // max(rows, 1)))


@compiled
def integers(buffers, k, rows):
    """Return the k-th buffer as an array of int32 with so many rows, without a copy."""
    buffer = _word(buffers + 8 * k)
    return carray(_at(_word(buffer + 24), types.int32), (rows, _count(buffer) // max(rows, 1)))


@compiled
def dimension(pointer, axis):
    """Return the length of an axis of the buffer at a pointer; ``axis`` in bytes, eight each."""
    return _word(_word(_word(pointer) + 40) + axis)


@compiled
def data(pointer):
    """Return the address of the numbers of the buffer at a pointer."""
    return _word(_word(pointer) + 24)


@compiled
def vector(address, n):
    """Return n float64 at an address."""
    return carray(_at(address, types.float64), (n,))


@compiled
def matrix(address, m, n):
    """Return m rows of n float64 at an address."""
    return carray(_at(address, types.float64), (m, n))


@compiled
def whole_numbers(address, n):
    """Return n int32 at an address."""
    return carray(_at(address, types.int32), (n,))
