"""CUDA texts of the core on a CPU, one thread after the other (``one_warp.hpp``)."""

import ctypes
import hashlib
import os
import re
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

SHARED = 1 << 18
_RUN = """
extern "C" void run(void** a, int problems) {
  auto kernel = [&] { osik_kernel(ARGUMENTS, problems); };
  run_blocks(problems, (char*)osik::shared_space, BYTES, sizeof osik::shared_space, kernel);
}
"""
_GROUPS = """
extern "C" void run(void** a, int problems) {
  blockDim.x = 32;
  char none[1];
  run_blocks((problems * MEMBERS + 31) / 32, none, 0, 0, [&] { osik_kernel(ARGUMENTS, problems); });
}
"""
_EACH_LANE = """
extern "C" void run(void** a, int problems) {
  for (blockIdx.x = 0; blockIdx.x < problems; ++blockIdx.x) osik_kernel(ARGUMENTS, problems);
}
"""


@cache
def of_warps(folder: Path, text: str, shared: int) -> ctypes.CDLL:
    """A kernel whose problems have a warp each, and so many bytes of shared memory, as a C library."""
    text, copies = re.subn(
        r'asm volatile\("cp\.async\.ca.*?\);', "*to = there ? *from : Real(0);", text, flags=re.DOTALL
    )
    text, waits = re.subn(r'asm volatile\("cp\.async\.wait_all.*?\);', "", text)
    space = "extern __shared__ __align__(16) double shared_space[];"
    assert (copies, waits, text.count(space)) == (1, 1, 1) and "asm" not in text
    text = text.replace(space, f"alignas(16) static double shared_space[{SHARED // 8}];")
    return compiled(folder, text + _RUN.replace("BYTES", str(shared)).replace("ARGUMENTS", arguments_of(text)))


def arguments_of(text: str) -> str:
    """Return C++ text of the arguments of a CUDA text's kernel: the pointers in the array `a`, cast to their types."""
    head = re.search(r"osik_kernel\((.*?),\s*int problems\)", text, re.DOTALL)
    assert head is not None
    types = [re.sub(r"\w+$", "", parameter.strip()) for parameter in head[1].split(",")]
    return ", ".join(f"({kind})a[{k}]" for k, kind in enumerate(types))


def compiled(folder: Path, text: str) -> ctypes.CDLL:
    """A CUDA text as a C library."""
    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    source, target = folder / f"{name}.cpp", folder / f"{name}.so"
    source.write_text('#include "one_warp.hpp"\n' + text)
    options = ("-std=c++20", "-O1", "-w", "-shared", "-fPIC", f"-I{Path(__file__).parent}")
    subprocess.run([os.environ.get("CXX") or "c++", *options, "-o", target, source], check=True)
    return ctypes.CDLL(str(target))


def call_of_warps(
    folder: Path,
    source: str,
    outputs: Sequence[tuple[tuple[int, ...], Any]],
    *inputs: Any,
    problems: int,
    shared: int,
    **_: Any,
) -> list[np.ndarray]:
    """Solve each problem with a warp on a CPU, in place of ``core/_cuda.call``; blocks that have none do nothing."""
    arrays = [np.ascontiguousarray(a) for a in inputs]
    results = [np.full(shape, np.nan if jnp.issubdtype(kind, jnp.floating) else -1, kind) for shape, kind in outputs]
    pointers = (ctypes.c_void_p * (len(arrays) + len(results)))(*(a.ctypes.data for a in (*arrays, *results)))
    of_warps(folder, source, shared).run(pointers, problems)
    return results


def call_of_lanes(
    folder: Path,
    source: str,
    outputs: Sequence[tuple[tuple[int, ...], Any]],
    *inputs: Any,
    problems: int,
    lanes_last: Sequence[bool],
    per_block: int = 64,
    **_: Any,
) -> list[np.ndarray]:
    """Compute a method of ``core/lanes_cuda.hpp`` for all lanes on a CPU, in place of ``core/_cuda.call``.

    Lanes of several threads are those of a warp, which all run.
    """
    members = 64 // per_block
    given = [
        np.ascontiguousarray(np.moveaxis(np.asarray(a), 0, -1) if last else a)
        for a, last in zip(inputs, lanes_last, strict=False)
    ]
    orders = lanes_last[len(inputs) :]
    shapes = [(*shape[1:], shape[0]) if last else shape for (shape, _), last in zip(outputs, orders, strict=True)]
    results = [
        np.full(shape, np.nan if jnp.issubdtype(kind, jnp.floating) else -9, kind)
        for shape, (_, kind) in zip(shapes, outputs, strict=True)
    ]
    pointers = (ctypes.c_void_p * (len(given) + len(results)))(*(a.ctypes.data for a in (*given, *results)))
    is_grouped = "const int members = a" in source
    run = _GROUPS.replace("MEMBERS", str(members)) if is_grouped else _EACH_LANE
    source = source.replace("__shared__ Real s", "static Real s")  # one of all threads
    compiled(folder, source + run.replace("ARGUMENTS", arguments_of(source))).run(pointers, problems)
    return [np.moveaxis(a, -1, 0) if last else a for a, last in zip(results, orders, strict=True)]
