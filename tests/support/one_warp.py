"""The CUDA text of the weighted QP on a CPU, one thread of a warp after the other (``one_warp.hpp``)."""

import ctypes
import os
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from osik_jax.solvers.qp import _cuda

SHARED = 1 << 18
_RUN = """
extern "C" void run(void** a, int problems) {
  auto kernel = [&] { osik_kernel(ARGUMENTS, problems); };
  run_blocks(problems, (char*)osik::shared_space, BYTES, sizeof osik::shared_space, kernel);
}
"""


class Found(NamedTuple):
    """The kernel's results."""

    x: np.ndarray
    multipliers: np.ndarray
    active: np.ndarray
    report: np.ndarray
    residual: np.ndarray


@cache
def library(folder: Path, m: int, n: int, p: int, single: bool) -> ctypes.CDLL:
    """The kernel of a shape as a C library."""
    text = _cuda._source(m, n, p, single, 1000, 1)
    text, copies = re.subn(
        r'asm volatile\("cp\.async\.ca.*?\);', "*to = there ? *from : Real(0);", text, flags=re.DOTALL
    )
    text, waits = re.subn(r'asm volatile\("cp\.async\.wait_all.*?\);', "", text)
    space = "extern __shared__ __align__(16) double shared_space[];"
    assert (copies, waits, text.count(space)) == (1, 1, 1) and "asm" not in text
    text = text.replace(space, f"alignas(16) static double shared_space[{SHARED // 8}];")
    head = re.search(r"osik_kernel\((.*?),\s*int problems\)", text, re.DOTALL)
    assert head is not None
    types = [re.sub(r"\w+$", "", parameter.strip()) for parameter in head[1].split(",")]
    arguments = ", ".join(f"({kind})a[{k}]" for k, kind in enumerate(types))
    run = _RUN.replace("BYTES", str(_cuda._bytes(m, n, p, single))).replace("ARGUMENTS", arguments)
    source, target = folder / f"{m}_{n}_{p}_{single}.cpp", folder / f"{m}_{n}_{p}_{single}.so"
    source.write_text('#include "one_warp.hpp"\n' + text + run)
    options = ("-std=c++20", "-O1", "-w", "-shared", "-fPIC", f"-I{Path(__file__).parent}")
    subprocess.run([os.environ.get("CXX") or "c++", *options, "-o", target, source], check=True)
    return ctypes.CDLL(str(target))


def solve(folder: Path, problems: tuple[np.ndarray, ...], guess: np.ndarray, tolerance: float, kind: type) -> Found:
    """Solve a batch: matrix, target, weight, damping, center, rows, compliance, lower and upper bounds."""
    (count, m, n), p = problems[0].shape, problems[5].shape[1]
    given = [np.ascontiguousarray(a, kind) for a in problems]
    given += [np.ascontiguousarray(guess, np.int32), np.full(count, tolerance, kind)]
    numbers, labels = ((n,), (p,)), ((n + p,), (3,))
    x, y = (np.zeros((count, *shape), kind) for shape in numbers)
    active, report = (np.zeros((count, *shape), np.int32) for shape in labels)
    residual, outside = np.zeros(count, kind), np.zeros((count, (2 * (n + p) + 6) * (n + p + 7)), kind)
    arrays = [*given, x, y, active, report, residual, outside]
    pointers = (ctypes.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays))
    library(folder, m, n, p, kind == np.float32).run(pointers, count)
    return Found(x, y, active, report, residual)
