"""Candidates for weighted QPs from the compiled core (``core/weighted_qp.hpp``)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core import _library
from ...execution._computed import side_by_side
from ...numerics._constants import INACTIVE, REDUNDANT
from ._cost import LeastSquares
from ._problem import QP, arrays


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
    p = qp.rows.shape[1]
    (matrix, *others), _ = arrays(qp)
    packed = side_by_side(*others) if qp.packed is None else qp.packed
    x, y, active, report = _library.call(
        "weighted_qp",
        _library.shapes_of(batch, ((n,), (p,)), ((n + p,), (3,))),
        *(matrix, packed, guess, tolerance, jnp.full(1, max_iterations, jnp.int32)),
    )
    return of_core(x, y, active, report)


class Candidate(NamedTuple):
    """Answers of a kernel for a batch."""

    x: Float[Array, "B n"]
    row_multipliers: Float[Array, "B p"]
    active: Int[Array, "B n+p"]
    converged: Int[Array, " B"]  # whether the kernel has nothing left to change; 2 on a GPU if it is certified
    iterations: Int[Array, " B"]
    factorizations: Int[Array, " B"]
    redundant: Bool[Array, "B n+p"] | None = None  # constraints that the active ones imply; None for none
    residual: Float[Array, " B"] | None = None  # ``kkt_residual``, of a GPU


def of_core(
    x: Float[Array, "B n"], row_multipliers: Float[Array, "B p"], active: Int[Array, "B n+p"], report: Int[Array, "B 3"]
) -> Candidate:
    """Return the core's candidates, whose labels may be REDUNDANT."""
    redundant = active == REDUNDANT
    active = jnp.where(redundant, INACTIVE, active)
    return Candidate(x, row_multipliers, active, *(report[:, i] for i in range(3)), redundant=redundant)
