"""Candidates for weighted QPs from the compiled core (``core/weighted_qp.hpp``)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...core import _library
from ...execution._computed import side_by_side
from ._candidate import Candidate, of_core
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
