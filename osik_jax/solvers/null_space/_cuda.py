"""GPU kernel of saturation in the null space (``core/saturation_cuda``), one warp of 32 threads per problem.

It is the method of ``core/saturation.hpp``, which takes 1.3 to 1.6 times as long there.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ...core import _cuda, _library
from ...numerics import _constants

PARTS = (
    *("workspace", "reductions", "calls", "problem", "level", "row_space", "cholesky", "damping", "motion"),
    *("saturated", "stop", "choices", "search", "attempt", "after", "levels"),
)
"""Files of the kernel in order; each uses the definitions of earlier ones."""
_MAX_ROWS, _MAX_WARPS = 64, 2
_WHOLE = ("DAMPING_ITERATIONS", "MAX_SATURATION_CHANGES", "PART", "PATH_SEARCHES", "SIGN_CHECKS", "STRAIGHT", "WHOLE")
_NUMBERS = (
    *("BLOCKING_RANK", "BOUND_DISTANCE", "COST_FRACTION", "DAMPING_RIDGE", "FULL_STEP", "LARGEST_RATE"),
    *("MIN_RADIUS", "NEGLIGIBLE_CURVATURE", "NEGLIGIBLE_DAMPING", "NEGLIGIBLE_ENTRY", "NEGLIGIBLE_STEP", "PATH_END"),
    *("PATH_STEP", "SATURATION_LOSS", "SATURATION_RANK", "SATURATION_RESIDUAL", "SATURATION_ROUNDOFF"),
    *("SATURATION_COMPLIANCE", "SOFT_SATURATION_RANK", "STIFFER_SATURATION_COMPLIANCE"),
)
"""Names of the constants from ``numerics/_constants.py`` in the kernel's text."""
_KERNEL = """
#define INFINITY __longlong_as_double(0x7ff0000000000000ll)
extern "C" __global__ void __launch_bounds__(32 * WARPS) osik_kernel(
    const double* matrix, const double* rows_lower, const double* rows_upper, const double* dampings,
    const double* bends, const double* targets, const double* lower, const double* upper,
    const double* rank_tolerance, const int* rows_equal, double* solution, double* projectors, double* scales,
    int* dones, int* joints_at_bounds, int* joints_blocking, int* blockers, int* active_joints, int* report,
    int problems) {
const int pid = (blockIdx.x * blockDim.x + threadIdx.x) / 32;
if (pid >= problems) return;
"""


class Shape(NamedTuple):
    """Sizes for which a kernel is compiled."""

    variables: int
    levels: int
    rows: int  # of the longest level

    @property
    def warps(self) -> int:
        """Return the number of warps per block; 0 if a problem is too large for this kernel."""
        n, m = self.variables, self.rows
        if m > _MAX_ROWS:
            return 0
        # rows have odd lengths, so that the threads of a warp read from different banks of memory
        wide = max(n, m)
        room = n * (wide | 1) + (0 if m * (m | 1) <= n * n else m * (m | 1))
        doubles = n * (n | 1) + room + 14 * n + 6 * m + wide
        return min(_MAX_WARPS, _cuda.DEFAULT_SHARED_BYTES // (8 * doubles + 4 * (6 * n + m)))


def fits(n: int, m: int) -> bool:
    """Return whether a GPU has room for a problem of n variables and levels of up to m rows."""
    return _cuda.installed() and Shape(n, 1, m).warps > 0


@cache
def _source(shape: Shape, max_iterations: int) -> str:
    """Return the CUDA text for a shape: its numbers as constants, then the body of the kernel."""
    n, levels, m = shape
    numbers = dict(N=n, LEVELS=levels, M=m, WARPS=shape.warps, max_iterations=max_iterations)
    numbers |= {name: getattr(_constants, name) for name in _WHOLE}
    floats = [f"constexpr double {name} = {getattr(_constants, name)!r};" for name in _NUMBERS]
    head = _cuda.constants(**numbers) + "\n".join(floats)
    return head + _KERNEL + _cuda.rolled(_cuda.text_of_parts("saturation_cuda", PARTS)) + "}\n"


def saturate(_: str, outputs: _library.Shapes, matrix: Array, *given: Any) -> list[Array]:
    """Saturate a batch on the default GPU: as ``_library.call`` of the method "saturation" does on a CPU."""
    lower, upper, equal, *damping, bends, targets, low, high, rank_tol, most_changes = given
    batch, levels, m, n = matrix.shape
    shape = Shape(n, levels, m)
    numbers = jnp.swapaxes(matrix, 2, 3), lower, upper, jnp.stack(damping, 1), bends, targets, low, high, rank_tol
    return _cuda.call(
        _source(shape, int(most_changes[0])),
        outputs,
        *map(_cuda.as_double, numbers),
        equal.astype(jnp.int32),
        problems=batch,
        shared=0,
        per_block=shape.warps,
        warps=shape.warps,
    )
