"""Weighted QPs without rows in single precision on a GPU (``core/weighted_qp_cuda``).

It has the factor of a warp's problem in registers. The text of the core (``core/weighted_qp.hpp``), which ``_cuda.py``
takes for all other problems, makes 0.7 times as many steps of a whole-body loop a second.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...core import _cuda, _library
from ...numerics._constants import (
    KERNEL_REFINEMENTS,
    KKT_RIDGE,
    LAST_CORRECTION,
    MAX_EXCHANGES,
    MAX_FACTORIZATIONS,
    MIN_DECREASE,
    VIOLATION_TOL,
)
from ._candidate import Candidate
from ._cost import LeastSquares
from ._problem import QP

PARTS = ("workspace", "vectors", "problem", "factor", "refine", "labels", "dual_step", "active_set")
"""Files of the kernel in order; each uses the definitions of earlier ones."""
_MAX_VARIABLES = 64
_MAX_WARPS = 4
_KERNEL = """
#define INFINITY __int_as_float(0x7f800000)
extern "C" __global__ void __launch_bounds__(32 * WARPS) osik_kernel(
    const float* matrix, const float* target, const float* weight, const float* damping, const float* center,
    const float* lower, const float* upper, const float* rows, const float* compliance, const int* guess,
    const float* tolerance, float* solution, float* row_multipliers, int* active, int* report, int problems) {
const int pid = (blockIdx.x * blockDim.x + threadIdx.x) / 32;
if (pid >= problems) return;
"""


class Shape(NamedTuple):
    """Sizes for which a kernel is compiled."""

    variables: int
    rows: int

    @property
    def warps(self) -> int:
        """Return the number of warps per block; 0 if a problem is too large for this kernel."""
        n, m = self
        if n > _MAX_VARIABLES:
            return 0
        length = 4 * ((n + 3) // 4 | 1)
        floats = (m + 1) * length + n * length + 5 * length + 3 * (m + 3) + 3
        return min(_MAX_WARPS, _cuda.DEFAULT_SHARED_BYTES // (4 * floats))


def fits(qp: QP) -> bool:
    """Return whether the kernel supports a problem: no rows, single precision, and enough shared memory."""
    if not isinstance(qp.cost, LeastSquares) or qp.lower.dtype != jnp.float32 or qp.rows.shape[-2]:
        return False
    m, n = qp.cost.matrix.shape[-2:]
    return Shape(n, m).warps > 0


@cache
def _source(shape: Shape, max_iterations: int) -> str:
    """Return the CUDA text for a shape: its numbers as constants, then the body of the kernel."""
    single = jnp.dtype("float32")
    numbers = dict(N=shape.variables, M=shape.rows, P=0, WARPS=shape.warps, max_iterations=max_iterations)
    numbers |= dict(MAX_REFINEMENTS=KERNEL_REFINEMENTS[single], MAX_FACTORIZATIONS=MAX_FACTORIZATIONS)
    numbers |= dict(MAX_EXCHANGES=MAX_EXCHANGES)
    floats = dict(RIDGE=KKT_RIDGE[single] * float(jnp.finfo(single).eps), LAST_CORRECTION=LAST_CORRECTION[single])
    floats |= dict(VIOLATION_TOL=VIOLATION_TOL, MIN_DECREASE=MIN_DECREASE)
    head = _cuda.constants(**numbers) + "\n".join(f"constexpr float {k} = {v!r}f;" for k, v in floats.items())
    return head + _KERNEL + _cuda.text_of_parts("weighted_qp_cuda", PARTS) + "}\n"


def solve(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Candidate:
    """Return candidates for a batch on the default GPU; arguments as for ``_cuda.solve``."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    batch, m, n = cost.matrix.shape
    shape, single = Shape(n, m), jnp.float32
    numbers = (cost.matrix, cost.target, cost.weight, cost.damping, cost.center, qp.lower, qp.upper)
    x, y, active, report = _cuda.call(
        _source(shape, max_iterations),
        _library.shapes_of(batch, ((n,), (0,)), ((n,), (3,)), single),
        *(a.astype(single) for a in (*numbers, qp.rows, qp.compliance)),
        guess.astype(jnp.int32),
        tolerance.astype(single),
        problems=batch,
        shared=0,
        per_block=shape.warps,
        warps=shape.warps,
    )
    return Candidate(x, y, active, *(report[:, i] for i in range(3)))
