"""The CUDA texts of the solvers, compiled by g++ and run on a CPU, one warp as 32 fibers (``emulated_warp.h``)."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++ to compile the kernel's text")

_TYPES = {"float": np.float32, "double": np.float64, "int": np.int32}


def emulated(
    text: str,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    folder: Path,
    *,
    backwards: bool = False,
    scalar: str = "max_iterations",
) -> Callable[..., Any]:
    """What ``_kernel`` returns, without a GPU: a function of JAX arrays and the cap on changes.

    Args:
        text: the body of the kernel's function.
        inputs: types of its input arrays by name.
        outputs: types of its output arrays by name.
        folder: where to compile.
        backwards: whether the last lane goes first.
        scalar: name of the whole number that is given beside the arrays.
    """
    kinds = {**inputs, **outputs}
    arrays = "\n".join(f"static Matrix<{kind}> {name};" for name, kind in kinds.items())
    arguments = ", ".join(f"{kind}* {name}_" for name, kind in kinds.items())
    taken = " ".join(f"{name}.data = {name}_;" for name in kinds)
    program = f"""#include "{Path(__file__).with_name("emulated_warp.h")}"
{arrays}
static int pid, {scalar};
static void thread() {{
{text}
end_thread();
}}
extern "C" void solve(int problems, int cap, {arguments}) {{
  {taken}
  {scalar} = cap;
  for (pid = 0; pid < problems; ++pid) run_warp(thread, {str(backwards).lower()});
}}
"""
    source = folder / "kernel.cpp"
    source.write_text(program)
    library = source.with_suffix(".so")
    flags = ["-std=c++17", "-O1", "-w", "-shared", "-fPIC", "-ffp-contract=fast"]
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    native = ctypes.CDLL(str(library))

    def call(*args: Any, launch_dims: int, output_dims: Mapping[str, tuple[int, ...]]) -> Any:
        *given, cap = args
        shapes = tuple(jax.ShapeDtypeStruct(output_dims[name], _TYPES[kind]) for name, kind in outputs.items())

        def on_host(*given: Any) -> Any:
            pairs = zip(given, inputs.values(), strict=True)
            taken = [np.ascontiguousarray(a, _TYPES[kind]) for a, kind in pairs]
            results = [np.full(s.shape, 77, s.dtype) for s in shapes]  # nothing may be left unwritten
            native.solve(launch_dims // 32, cap, *(a.ctypes.data_as(ctypes.c_void_p) for a in (*taken, *results)))
            return tuple(results)

        return jax.pure_callback(on_host, shapes, *given)

    return call
