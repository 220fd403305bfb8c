"""Null-space projections on a GPU, one warp of 32 threads per problem.

The methods are in ``core/null_space.hpp`` and ``core/saturation.hpp``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ...core import _cuda, _library

_MAX_RANK = 64  # the triangular solves of a warp hold two entries a thread
_PROBLEMS = """
  const NullSpaceSizes sizes{N, M};
  Method method(sizes, nullptr, outside + size_t(blockIdx.x) * Method::numbers_outside(sizes));
  for (int i = 0; i < PER_BLOCK; ++i) {
    const size_t b = size_t(blockIdx.x) * PER_BLOCK + i;
    if (b >= problems) return;
"""
_PROJECTION = """
using namespace osik;
using Method = ClassicalProjection<Warp<double, N, M, 0>>;
extern "C" __global__ void __launch_bounds__(32, BLOCKS) osik_kernel(
    const double* secondary, const double* constant, const double* unmet, const double* demand, const double* bends,
    const double* rank_tol, LEVELS, double* x, double* projector, double* outside, int problems) {
  const double* const matrices[] = {MATRIX};
  const double* const lowers[] = {LOWER};
  const double* const uppers[] = {UPPER};
  const int* const equalities[] = {EQUAL};
  PROBLEMS
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
_SATURATION = """
using namespace osik;
using Method = Saturation<Warp<double, N, M, 0>>;
extern "C" __global__ void __launch_bounds__(32, BLOCKS) osik_kernel(
    const double* matrix, const double* lower, const double* upper, const int* equality, const double* constant,
    const double* unmet, const double* demand, const double* bends, const double* targets, const double* low,
    const double* high, const double* rank_tol, double* x, double* projector, double* scales, int* ended, int* sides,
    int* blocking, int* blockers, int* active, int* report, double* outside, int problems) {
  PROBLEMS
    const size_t e = b * L, row = e * M, joint = b * N;
    method.solve({matrix + row * N, lower + row, upper + row, constant + e, unmet + e, demand + e, bends + e * N,
                  targets + e * N, low + joint, high + joint, equality + row, rank_tol[b], MAX_CHANGES, L, M, 1, M},
                 {x + joint, projector + joint * N, scales + e, ended + e, sides + e * N, blocking + e * N,
                  blockers + e, active + joint, report + b * 2});
  }
}
"""


def fits(n: int, rows: Sequence[int], method: str = "projection") -> bool:
    """Return whether a GPU has room for a problem of n variables and levels of so many rows."""
    most = max(rows)
    return _cuda.installed() and min(n, most) <= _MAX_RANK and _cuda.space_of(method, n, most) <= _cuda.shared_bytes()


def project(_: str, outputs: _library.Shapes, secondary: Array, *given: Array) -> list[Array]:
    """Project a batch on the default GPU: as ``_library.call`` of the method "projection" does on a CPU."""
    n, kind = secondary.shape[1], secondary.dtype
    numbers, levels = given[:5], list(given[5:])
    # column by column, so that the threads of a warp read neighbours
    levels[::4] = [jnp.swapaxes(matrix, 1, 2) for matrix in levels[::4]]
    rows = tuple(a.shape[1] for a in levels[1::4])
    shapes = [(shape, jnp.float64) for shape, _ in outputs]
    results = _call("projection", shapes, (secondary, *numbers, *levels), n, rows)
    return [a.astype(kind) for a in results]


def saturate(_: str, outputs: _library.Shapes, matrix: Array, *given: Any) -> list[Array]:
    """Saturate a batch on the default GPU: as ``_library.call`` of the method "saturation" does on a CPU."""
    *numbers, most_changes = given
    levels, m, n = matrix.shape[1:]
    inputs = jnp.swapaxes(matrix, 2, 3), *numbers
    return _call("saturation", outputs, inputs, n, (m,) * levels, int(most_changes[0]))


def _call(
    method: str, outputs: _library.Shapes, inputs: Sequence[Array], n: int, rows: tuple[int, ...], max_changes: int = 0
) -> list[Array]:
    """Run a kernel for a batch: each block solves one problem or several in turn."""
    batch, sizes = len(inputs[0]), (n, max(rows))
    per_block = _cuda.problems_of_a_block(batch)
    outside = -(-batch // per_block), _cuda.space_outside("null_space", *sizes)
    results = _cuda.call(
        _source(method, n, rows, per_block, max_changes),
        [*outputs, (outside, jnp.float64)],
        *(a.astype(jnp.int32) if a.dtype == bool else _cuda.as_double(a) for a in inputs),
        problems=batch,
        shared=_cuda.space_of(method, *sizes),
        per_block=per_block,
    )
    return results[:-1]  # without the workspace in global memory


@cache
def _source(method: str, n: int, rows: tuple[int, ...], per_block: int, max_changes: int = 0) -> str:
    """Return the CUDA text of a method for levels of so many rows."""
    m = max(rows)
    numbers = dict(PER_BLOCK=per_block, BLOCKS=_cuda.blocks_beside(_cuda.space_of(method, n, m)))
    sizes = _cuda.constants(N=n, M=m, L=len(rows), ROWS=rows, MAX_CHANGES=max_changes, **numbers)
    header, kernel = (
        ("null_space.hpp", _projection(len(rows))) if method == "projection" else ("saturation.hpp", _SATURATION)
    )
    return _cuda.text_of(header) + sizes + _cuda.rolled(kernel.replace("PROBLEMS", _PROBLEMS))


def _projection(levels: int) -> str:
    """Return the kernel of the classical projection, which has arguments for each level."""
    names = {name: [f"{name.lower()}{k}" for k in range(levels)] for name in ("MATRIX", "LOWER", "UPPER", "EQUAL")}
    parameters = [name for level in zip(*names.values(), strict=True) for name in level]
    arguments = ", ".join(f"const {'int' if 'equal' in name else 'double'}* {name}" for name in parameters)
    text = _PROJECTION.replace("LEVELS", arguments)
    for key, own in names.items():
        text = text.replace(key, ", ".join(own))
    return text
