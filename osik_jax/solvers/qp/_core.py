"""Candidates for weighted QPs from the core (``core/weighted_qp.hpp``); on a GPU one warp of 32 threads a problem."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...core import _cuda, _library
from ...execution._computed import side_by_side
from ...numerics._constants import INACTIVE, KKT_TOLERANCE, REDUNDANT, SINGLE_TOL
from ._problem import QP, LeastSquares

CERTIFIED, LEAST_VIOLATION = 2, 3
"""``Candidate.converged`` of a candidate that solves its problem, or misses hard rows that contradict each other or the
box as little as possible; 1: there is a candidate."""


class Candidate(NamedTuple):
    """Answers of a kernel for a batch."""

    x: Float[Array, "B n"]
    row_multipliers: Float[Array, "B p"]
    active: Int[Array, "B n+p"]
    converged: Int[Array, " B"]
    iterations: Int[Array, " B"]
    factorizations: Int[Array, " B"]
    residual: Float[Array, " B"]  # ``kkt_residual``


def solve(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Candidate:
    """Return candidates for a batch of QPs, from a guess of their active sets.

    ``tolerance`` is the violation that counts as none, relative to the scale of the constraint; ``max_iterations``
    limits the changes of the active set.
    """
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    batch, _, n = cost.matrix.shape
    p, (matrix, *others) = qp.rows.shape[1], jax.tree.leaves(qp)
    tolerances = jnp.stack([tolerance, jnp.full_like(tolerance, KKT_TOLERANCE[tolerance.dtype])], 1)
    x, y, active, report, residual = _library.call(
        "weighted_qp",
        [*_library.shapes_of(batch, ((n,), (p,)), ((n + p,), (3,))), ((batch,), float)],
        *(matrix, side_by_side(*others), guess, tolerances, jnp.full(1, max_iterations, jnp.int32)),
    )
    return of_core(x, y, active, report, residual)


def of_core(
    x: Float[Array, "B n"],
    row_multipliers: Float[Array, "B p"],
    active: Int[Array, "B n+p"],
    report: Int[Array, "B 3"],
    residual: Float[Array, " B"],
) -> Candidate:
    """Return the core's candidates; constraints that the active ones imply are inactive."""
    active = jnp.where(active == REDUNDANT, INACTIVE, active)
    converged, iterations, factorizations = report.T
    return Candidate(x, row_multipliers, active, converged, iterations, factorizations, residual)


_KERNEL = """
using namespace osik;
using Method = WeightedQP<Warp<Real, N, M, P>>;
extern "C" __global__ void __launch_bounds__(32, BLOCKS) osik_kernel(
    const Real* matrix, const Real* target, const Real* weight, const Real* damping, const Real* center,
    const Real* rows, const Real* compliance, const Real* lower, const Real* upper, const int* guess,
    const Real* tolerance, Real* x, Real* multipliers, int* active, int* report, Real* residual, Real* outside,
    int problems) {
  const QPSizes s{M, N, P, MAX_CHANGES};
  Method method(s, nullptr, outside + size_t(blockIdx.x) * DualActiveSet<Warp<Real, N, M, P>>::doubles(N, P));
  QPCertificate<Warp<Real, N, M, P>> certificate(s, nullptr);
  for (int b = 0; b < PER_BLOCK; ++b) {
    const size_t k = size_t(blockIdx.x) * PER_BLOCK + b;
    if (k >= problems) return;
    const QPData<Real> d{matrix + k * M * N, target + k * M, weight + k * M, damping + k * N, center + k * N,
                         rows + k * P * N, compliance + k * P, lower + k * (N + P), upper + k * (N + P),
                         guess + k * (N + P), tolerance[k]};
    const QPAnswer<Real> to{x + k * N, multipliers + k * P, active + k * (N + P), report + k * 3};
    const Certificate found = certificate.solve(method, d, to, KKT_TOLERANCE);
    if (threadIdx.x == 0) residual[k] = found.residual;
  }
}
"""


def fits(qp: QP, *, single: bool | None = None) -> bool:
    """Return whether the GPU kernel supports a problem: least squares that fit its shared memory.

    ``single``: in single precision, or not; default: that of the data.
    """
    if not isinstance(qp.cost, LeastSquares) or not _cuda.installed():
        return False
    m, n = qp.cost.matrix.shape[-2:]
    own = qp.lower.dtype == jnp.float32 if single is None else single
    return _bytes(m, n, qp.rows.shape[-2], bool(own)) <= _cuda.shared_bytes()


def _bytes(m: int, n: int, p: int, single: bool) -> int:
    return _cuda.space_of("weighted_qp", m, n, p, int(single))


@cache
def _source(m: int, n: int, p: int, single: bool, max_changes: int, per_block: int) -> str:
    blocks = _cuda.blocks_beside(_bytes(m, n, p, single))
    sizes = _cuda.constants(M=m, N=n, P=p, MAX_CHANGES=max_changes, PER_BLOCK=per_block, BLOCKS=blocks)
    tolerance = KKT_TOLERANCE[jnp.dtype("float32" if single else "float64")]
    kind = f"using Real = {'float' if single else 'double'};\nconstexpr Real KKT_TOLERANCE = {tolerance};\n"
    return _cuda.text_of("qp_certificate.hpp") + sizes + kind + _KERNEL


def solve_on_gpu(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Candidate:
    """Return candidates for a batch from the GPU, in the precision of the data; arguments as for ``solve``."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    batch, m, n = cost.matrix.shape
    p, kind = qp.rows.shape[1], cost.matrix.dtype
    sizes = m, n, p, kind == jnp.float32
    tolerance = jnp.maximum(tolerance, SINGLE_TOL) if kind == jnp.float32 else tolerance
    numbers = (cost.matrix, cost.target, cost.weight, cost.damping, cost.center, qp.rows, qp.compliance)
    per_block, most = _cuda.problems_of_a_block(batch), n + p
    # of the dual method, which few problems need
    outside = -(-batch // per_block), _cuda.space_outside("weighted_qp", n, p, int(kind == jnp.float32))
    x, y, active, report, residual, _ = _cuda.call(
        _source(*sizes, max_iterations, per_block),
        [*_library.shapes_of(batch, ((n,), (p,)), ((most,), (3,)), kind), ((batch,), kind), (outside, kind)],
        *(a.astype(kind) for a in (*numbers, qp.lower, qp.upper)),
        guess.astype(jnp.int32),
        tolerance.astype(kind),
        problems=batch,
        shared=_bytes(*sizes),
        per_block=per_block,
    )
    return of_core(x, y, active, report, residual)
