"""Candidates: outputs of a kernel for a batch of QPs."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import INACTIVE, REDUNDANT


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
