"""Candidates for weighted QPs on a CPU: Numba's kernel (``kernels/numba/_weighted_qp.py``), called from JAX."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..kernels.numba import _target
from ._cost import LeastSquares
from ._kernel import Proposal
from ._problem import QP


def propose(qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], max_iterations: int) -> Proposal:
    """Working sets, minimisers and row multipliers of a batch; each lane takes as long as it needs."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    lanes, m, n = cost.matrix.shape
    p = qp.rows.shape[1]
    k, constraints = m + p, n + p
    most = max(n, k)
    space = 2 * k * n + most**2 + p * (n + p) + 2 * constraints**2 + 18 * (most + constraints)  # as Work has it
    given = (cost.matrix, cost.target, cost.weight, cost.damping, cost.center, qp.lower, qp.upper)
    x, y, active, report, _ = _target.call(
        "_weighted_qp",
        [((lanes, n), float), ((lanes, p), float), ((lanes, n + p), int), ((lanes, 3), int), ((space,), float)],
        *(*given, qp.rows, qp.compliance, guess, tolerance, jnp.full(1, max_iterations, jnp.int32)),
    )
    return Proposal(x, y, active, *(report[:, i] for i in range(3)))
