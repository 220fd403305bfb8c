"""GPU calls of the core's methods: CUDA text specialised for the problem sizes, compiled by NVRTC at the first call."""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
import posixpath
import re
import sys
from collections.abc import Sequence
from functools import cache
from glob import glob
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from . import _build, _library

_OLDEST = 8  # compute capability that the texts need: copies to shared memory in the background, sums over a warp
_CAPABILITY = 75  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR
_SHARED_BYTES = 97  # CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN
DEFAULT_SHARED_BYTES = 48 * 1024
"""Shared memory [bytes] that every CUDA device offers a block by default."""
_MOST_SPACES = 1 << 14
_MOST_KEPT = 1024
"""Numbers of an argument that all lanes share and a block keeps in its shared memory."""
_MOST_NUMBERS = 8
"""Length of results that a thread writes side by side: of longer ones the threads of a warp write neighbours."""
_LOCAL_INCLUDE = re.compile(r'^#include "(.*)"\n', re.MULTILINE)
# a loop stays a loop unless the line before it asks to unroll it: unrolled, the text exceeds the instruction cache
_LOOP = re.compile(r"(?<!unroll\n)(?<!unroll \d\n)(?<!UNROLL\n)(?<!UNROLL_4\n)^ *(?:for|while) \(", re.MULTILINE)
_SYSTEM_INCLUDE = re.compile(r"^#include <.*>\n", re.MULTILINE)


def installed() -> bool:
    """Return whether the core and NVRTC are installed, for a device that can run their texts."""
    found = _library.core().library is not None and nvrtc() is not None
    return found and (_attribute(_CAPABILITY) or _OLDEST) >= _OLDEST


def shared_bytes() -> int:
    """Return the largest shared memory of a block [bytes]: that of the first device, or 227 KiB if it is not known.

    Problems that need more are solved in plain JAX.
    """
    return _attribute(_SHARED_BYTES) or 227 * 1024


def blocks_beside(shared: int) -> int:
    """Return how many blocks that take so many bytes of shared memory fit on a multiprocessor, up to 16.

    A kernel's launch bounds name this number: without it the compiler keeps fewer registers than there are. With 16
    blocks of a warp each thread may have 128.
    """
    of_system = 1024  # bytes that CUDA takes of each block
    return max(1, min((shared_bytes() + of_system) // (shared + of_system), 16))


@cache
def _attribute(which: int) -> int | None:
    """Return an attribute of the first device, by CUDA's driver; None if that does not say."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return None
    device, value = ctypes.c_int(), ctypes.c_int()
    calls = (
        lambda: driver.cuInit(0),
        lambda: driver.cuDeviceGet(ctypes.byref(device), 0),
        lambda: driver.cuDeviceGetAttribute(ctypes.byref(value), which, device),
    )
    return value.value if all(call() == 0 for call in calls) else None


@cache
def nvrtc() -> str | None:
    """Return the path of the NVRTC library: from the wheels of JAX's CUDA extra, else from a CUDA toolkit."""
    folders = [*sys.path, "/usr/local/cuda"]
    patterns = ("nvidia/**/lib/libnvrtc.so.*", "lib64/libnvrtc.so*")
    found = [path for folder in folders for pattern in patterns for path in glob(f"{folder}/{pattern}", recursive=True)]
    libraries = [path for path in found if "builtins" not in path and ".alt." not in path]
    return libraries[0] if libraries else None


@cache
def text_of(header: str) -> str:
    """Return a header of the core with all headers it includes, as one text for NVRTC."""
    seen: set[str] = set()

    def inlined(name: str, folder: str = "") -> str:
        name = posixpath.normpath(posixpath.join(folder, name))
        if name in seen or name in ("serial.hpp", "lanes.hpp"):  # the team of a CPU, and its packs
            return ""
        seen.add(name)
        text = _SYSTEM_INCLUDE.sub("", (_build.FOLDER / name).read_text()).replace("#pragma once\n", "")
        return _LOCAL_INCLUDE.sub(lambda match: inlined(match[1], posixpath.dirname(name)), text)

    return rolled(inlined(header))


def rolled(text: str) -> str:
    """Return CUDA text with loop unrolling disabled, except for loops marked for unrolling."""
    return _LOOP.sub(r"#pragma unroll 1\n\g<0>", text)


def call(
    source: str,
    outputs: Sequence[tuple[tuple[int, ...], Any]],
    *inputs: Array,
    problems: int,
    shared: int,
    per_block: int = 1,
    warps: int = 1,
    lanes_last: Sequence[bool] = (),
) -> list[Array]:
    """Launch a compiled kernel named ``osik_kernel`` through XLA.

    Inputs have the dtypes and memory layout that the kernel expects, results the given shapes and dtypes. One problem
    takes ``shared`` bytes of shared memory, a block solves ``per_block`` problems and has ``warps`` warps.
    ``lanes_last`` says, for the inputs and then the results, whether the leading axis is the fastest in memory.
    """
    _register()
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in outputs]
    key = hashlib.sha256(source.encode()).hexdigest()[:24]
    numbers = dict(problems=problems, per_block=per_block, threads=32 * warps, shared=shared)
    with jax.enable_x64(True):
        arrays, count = (*inputs, *shapes), len(inputs)
        orders = [_order(a.ndim, last) for a, last in zip(arrays, lanes_last or [False] * len(arrays), strict=True)]
        run = jax.ffi.ffi_call("osik_cuda", shapes, input_layouts=orders[:count], output_layouts=orders[count:])
        return list(run(*inputs, source=source, key=key, **{name: np.int32(n) for name, n in numbers.items()}))


def call_lanes(
    method: str, outputs: Sequence[tuple[tuple[int, ...], Any]], *inputs: Any, space: int = 0, members: int = 1
) -> list[Array]:
    """Call a method of ``core/kinematic_calls.hpp`` and the like on a GPU. A lane is a robot or a target of the batch.

    ``method`` is its CPU handler without the prefix "osik_". Inputs are floats of one precision with a leading axis of
    lanes, or of length 1, and arrays of integers, flat or with such an axis; results are floats of that precision, or
    integers. ``space`` is the workspace of a thread in numbers. ``members``: threads of each lane, a power of two up to
    32; a method with groups has it as the last of its options.
    """
    arrays = [jnp.asarray(a) for a in inputs]
    real = next(a.dtype for a in arrays if _is_real(a))
    arrays = [a.astype(real if _is_real(a) else jnp.int32) for a in arrays]
    lanes = outputs[0][0][0]
    given = tuple((min(len(a), 2), *a.shape[1:]) if _is_real(a) or a.ndim > 1 else a.shape for a in arrays)
    integers = tuple(k for k, a in enumerate(arrays) if not _is_real(a))
    results = tuple((min(lanes, 2), *shape[1:]) for shape, _ in outputs)
    labels = tuple(k for k, (_, kind) in enumerate(outputs) if not jnp.issubdtype(jnp.dtype(kind), jnp.floating))
    source = _lanes_source(method, real == jnp.float32, given, integers, results, labels, space)
    shapes = [(shape, jnp.int32 if k in labels else real) for k, (shape, _) in enumerate(outputs)]
    last = [*_lanes_last(given), *_lanes_last(results, _MOST_NUMBERS)]
    return call(source, shapes, *arrays, problems=lanes, shared=0, per_block=64 // members, warps=2, lanes_last=last)


_METHODS = {
    "kinematics": "place",
    "moving_frames": "move_frames",
    "center_of_mass": "move_centers",
    "center_rows": "find_center_rows",
    "pose_rows": "find_pose_rows",
    "frame_rows": "find_frame_rows",
    "chain_steps": "advance_chain",
    "chain_find": "find_chain",
    "free_find": "find_free",
    "clearances": "find_clearances",
    "are_free": "find_free_ones",
    "near_rows": "find_near_rows",
    "near_geometry": "find_near_geometry",
}
_GROUPED = {"chain_find": 4, "free_find": 4, "near_rows": 10, "near_geometry": 10}
"""Methods whose lanes have several threads, and the argument whose last number says how many."""


@cache
def _lanes_source(
    method: str,
    single: bool,
    given: tuple[tuple[int, ...], ...],
    integers: tuple[int, ...],
    results: tuple[tuple[int, ...], ...],
    labels: tuple[int, ...] = (),
    space: int = 0,
) -> str:
    """Return CUDA text that runs a method for each lane.

    The leading axis of an argument that all lanes share is 1, else 2, and so is that of the results if there is one
    lane. ``labels``: results that are integers.
    """

    def table(name: str, shapes: Sequence[tuple[int, ...]]) -> str:
        rows = ", ".join("{" + ", ".join(map(str, shape)) + "}" for shape in shapes)
        head = f"static constexpr int {name}(int k, int axis)"
        return f"{head} {{ constexpr int sizes[][4] = {{{rows}}}; return sizes[k][axis]; }}\n"

    def names(letter: str, count: int) -> str:
        return ", ".join(f"{letter}{k}" for k in range(count))

    kept = [
        k for k, shape in enumerate(given) if k not in integers and shape[0] == 1 and 0 < math.prod(shape) <= _MOST_KEPT
    ]
    copies = [
        f"__shared__ Real s{k}[{math.prod(given[k])}];\n"
        f"for (int i = threadIdx.x; i < {math.prod(given[k])}; i += blockDim.x) s{k}[i] = a{k}[i];\n"
        for k in kept
    ]

    options = _GROUPED.get(method)
    members = 1 if options is None else f"a{options}[{given[options][0] - 1}]"
    parameters = [f"const {'int' if k in integers else 'Real'}* a{k}" for k in range(len(given))]
    parameters += [f"{'int' if k in labels else 'Real'}* r{k}" for k in range(len(results))]
    return (
        text_of("lanes_cuda.hpp")
        + f"using namespace osik;\nusing Real = {'float' if single else 'double'};\nstruct Sizes {{\n"
        + f"static constexpr int SPACE = {max(space, 1)};\n"
        + table("argument", given)
        + table("result", results)
        + f"static constexpr unsigned LANES_LAST = {_mask(_lanes_last(given))};\n"
        + f"static constexpr unsigned RESULTS_LANES_LAST = {_mask(_lanes_last(results, _MOST_NUMBERS))};\n"
        + f'}};\nextern "C" __global__ void osik_kernel({", ".join(parameters)}, int problems) {{\n'
        + "".join(copies)
        + "__syncthreads();\n" * bool(copies)
        + f"const void* arguments[] = {{{names('a', len(given))}}};\n"
        + f"void* results[] = {{{names('r', len(results))}}};\n"
        + f"const Real* kept[] = {{{', '.join(f's{k}' if k in kept else 'nullptr' for k in range(len(given)))}}};\n"
        + f"const int members = {members};\n"
        + f"{_METHODS[method]}(ThreadCall<Real, Sizes>{{arguments, results, kept, problems, members}});\n}}\n"
    )


def _lanes_last(shapes: Sequence[tuple[int, ...]], most: int | None = None) -> list[bool]:
    """Return in which arrays the lanes are the fastest axis: in matrices, and in vectors of more than ``most`` numbers.

    All others are as XLA has them, which would have to turn them.
    """
    is_long = [len(shape) == 2 and most is not None and shape[1] > most for shape in shapes]
    return [shape[0] > 1 and (len(shape) > 2 or long) for shape, long in zip(shapes, is_long, strict=True)]


def _mask(flags: Sequence[bool]) -> int:
    return sum(flag << k for k, flag in enumerate(flags))


def _is_real(a: Any) -> bool:
    return jnp.issubdtype(a.dtype, jnp.floating)


def _order(axes: int, lanes_last: bool) -> tuple[int, ...]:
    """Return the axes of an array from the slowest in memory to the fastest."""
    return (*range(1, axes), 0) if lanes_last else tuple(range(axes))


@cache
def space_of(method: str, *sizes: int) -> int:
    """Return the shared memory that a problem of these sizes takes [bytes], by the core's ``osik_{method}_bytes``."""
    return getattr(_library.core().library, f"osik_{method}_bytes")(*sizes)


@cache
def space_of_lane(method: str, *sizes: int) -> int:
    """Return how many numbers of workspace a thread takes, by the core's ``osik_{method}_space``."""
    return getattr(_library.core().library, f"osik_{method}_space")(*sizes)


@cache
def space_outside(method: str, *sizes: int) -> int:
    """Return how many numbers of a problem are in global memory, by the core's ``osik_{method}_outside``."""
    return getattr(_library.core().library, f"osik_{method}_outside")(*sizes)


def problems_of_a_block(problems: int) -> int:
    """Return how many problems each block solves, so that the workspace of all blocks in global memory is bounded."""
    return -(-problems // _MOST_SPACES)


@cache
def _register() -> None:
    library = _library.core().library
    assert library is not None
    folder = cache_folder()
    library.osik_cuda_paths((nvrtc() or "libnvrtc.so").encode(), folder.encode())
    jax.ffi.register_ffi_target("osik_cuda", jax.ffi.pycapsule(library.osik_cuda), platform="CUDA")


def cache_folder() -> str:
    """Return the folder of compiled kernels, created if necessary; "" if it cannot be written."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "osik_jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return ""
    return str(folder) if os.access(folder, os.W_OK) else ""


def constants(**values: Any) -> str:
    """Return C++ constant definitions of numbers and non-empty lists of integers."""
    lines = []
    for name, value in values.items():
        if isinstance(value, Sequence):
            entries = ", ".join(map(str, value)) or "0"
            lines.append(f"__device__ const int {name}[] = {{{entries}}};")
        else:
            lines.append(f"constexpr int {name} = {value};")
    return "\n".join(lines) + "\n"


def as_double(a: Any) -> Array:
    """Return numbers in double precision, regardless of JAX's default."""
    with jax.enable_x64(True):
        return jnp.asarray(a).astype(jnp.float64)
