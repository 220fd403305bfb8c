"""Candidates for weighted QPs from the compiled core (``core/weighted_qp.hpp``)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...core import _library
from ...execution._computed import side_by_side
from ...numerics._constants import INACTIVE, KKT_TOLERANCE, REDUNDANT
from ._cost import LeastSquares
from ._problem import QP

CERTIFIED = 2
"""``Candidate.converged`` of a candidate that solves its problem; 1: there is one."""


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
    """Return candidates for a batch of QPs.

    Args:
        qp: the problems, with a leading axis.
        guess: labels of the active sets to try first.
        tolerance: violation that counts as none, relative to the scale of the constraint.
        max_iterations: limit on the changes of the active set (static).
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
