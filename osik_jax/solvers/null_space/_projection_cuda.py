"""The classical projection on a GPU (``core/null_space.hpp``), one warp of 32 threads per problem."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ...core import _cuda

_MAX_RANK = 64  # the triangular solves of a warp hold two entries a thread
_KERNEL = """
using namespace osik;
using Method = ClassicalProjection<Warp<double, N, M, 0>>;
extern "C" __global__ void __launch_bounds__(32, BLOCKS) osik_kernel(
    const double* secondary, const double* constant, const double* unmet, const double* demand, const double* bends,
    const double* rank_tol, LEVELS, double* x, double* projector, double* outside, int problems) {
  const double* const matrices[] = {MATRIX};
  const double* const lowers[] = {LOWER};
  const double* const uppers[] = {UPPER};
  const int* const equalities[] = {EQUAL};
  const NullSpaceSizes sizes{N, M};
  Method method(sizes, nullptr, outside + size_t(blockIdx.x) * Method::numbers_outside(sizes));
  for (int i = 0; i < PER_BLOCK; ++i) {
    const size_t b = size_t(blockIdx.x) * PER_BLOCK + i;
    if (b >= problems) return;
    method.rank_tol = rank_tol[b];
    method.begin();
    for (int k = 0; k < L; ++k) {
      const int rows = ROWS[k];
      const size_t e = b * L + k, first = b * rows;
      method.solve_level({matrices[k] + first * N, lowers[k] + first, uppers[k] + first, bends + e * N,
                          equalities[k] + first, constant[e], unmet[e], demand[e], rows, 1, rows});
    }
    method.end(secondary + b * N, x + b * N, projector + b * N * N);
  }
}
"""


def fits(n: int, rows: Sequence[int]) -> bool:
    """Return whether a GPU has room for a problem of n variables and levels of so many rows."""
    most = max(rows)
    return (
        _cuda.installed()
        and min(n, most) <= _MAX_RANK
        and _cuda.space_of("null_space", n, most) <= _cuda.shared_bytes()
    )


@cache
def _source(n: int, rows: tuple[int, ...], per_block: int) -> str:
    def names(kind: str) -> list[str]:
        return [f"{kind}{k}" for k in range(len(rows))]

    columns = {"MATRIX": names("matrix"), "LOWER": names("lower"), "UPPER": names("upper"), "EQUAL": names("equal")}
    levels = [name for level in zip(*columns.values(), strict=True) for name in level]
    text = _KERNEL.replace("LEVELS", ", ".join(f"const {'int' if 'equal' in a else 'double'}* {a}" for a in levels))
    for key, own in columns.items():
        text = text.replace(key, ", ".join(own))
    m = max(rows)
    blocks = _cuda.blocks_beside(_cuda.space_of("null_space", n, m))
    sizes = _cuda.constants(N=n, M=m, L=len(rows), ROWS=rows, PER_BLOCK=per_block, BLOCKS=blocks)
    return _cuda.text_of("null_space.hpp") + sizes + _cuda.rolled(text)


def call(_: str, outputs: Sequence[tuple[tuple[int, ...], Any]], secondary: Array, *given: Array) -> list[Array]:
    """Solve a batch on the default GPU: as ``_library.call`` of the method "projection" does on a CPU."""
    (batch, n), kind = secondary.shape, secondary.dtype
    numbers, levels = given[:5], list(given[5:])
    # column by column, so that the threads of a warp read neighbours
    levels[::4] = [jnp.swapaxes(matrix, 1, 2) for matrix in levels[::4]]
    rows = tuple(a.shape[1] for a in levels[1::4])
    arrays = [a.astype(jnp.int32) if a.dtype == bool else _cuda.as_double(a) for a in (secondary, *numbers, *levels)]
    per_block, sizes = _cuda.problems_of_a_block(batch), (n, max(rows))
    outside = -(-batch // per_block), _cuda.space_outside("null_space", *sizes)
    results = _cuda.call(
        _source(n, rows, per_block),
        [(shape, jnp.float64) for shape in (*(shape for shape, _ in outputs), outside)],
        *arrays,
        problems=batch,
        shared=_cuda.space_of("null_space", *sizes),
        per_block=per_block,
    )
    return [a.astype(kind) for a in results[:-1]]  # without what is outside
