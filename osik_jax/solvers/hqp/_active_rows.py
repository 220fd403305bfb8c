"""Orthonormal factors of the active hard rows within the null space of the frozen rows."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._dense import apply, product
from ._problem import LevelProblem


class ActiveRows(NamedTuple):
    """Factors N' = basis triangle of the active rows N, scaled to unit length, by pivoted QR."""

    index: Int[Array, " n"]  # of each pivot, its index among the hard rows
    valid: Bool[Array, " n"]  # active, and independent of the frozen rows and of the pivots before
    length: Float[Array, " n"]
    basis: Float[Array, "n n"]  # orthonormal columns, 0 where not valid
    triangle: Float[Array, "n n"]  # upper triangular, the identity where not valid
    projector: Float[Array, "n n"]  # onto the null space of frozen and active rows


def factor_active_rows(problem: LevelProblem, active: Int[Array, " h"], rank_tol: Array | float) -> ActiveRows:
    """Factor the active hard rows within the null space of the frozen rows.

    A unit row is dependent if less than ``rank_tol`` of its length lies outside the span of the others.
    """
    n = len(problem.x)
    is_active = active != 0
    # at most n rows are independent, so the first n after a stable sort that puts active rows first are all
    first = jnp.argsort(~is_active, stable=True)[:n]
    length = problem.length[first]
    unit = jnp.where(is_active[first], 1.0 / jnp.where(length > 0.0, length, 1.0), 0.0)
    normals = product(problem.hard[first] * unit[:, None], problem.projector)
    basis, triangle, order = jax.scipy.linalg.qr(normals.T, mode="economic", pivoting=True)
    valid = jnp.abs(jnp.diagonal(triangle)) > rank_tol
    basis = jnp.where(valid, basis, 0.0)
    return ActiveRows(
        index=first[order],
        valid=valid,
        length=length[order],
        basis=basis,
        triangle=jnp.where(valid[:, None] & valid[None, :], triangle, jnp.eye(n, dtype=basis.dtype)),
        projector=problem.projector - product(basis, basis.T),
    )


def restoring_step(
    problem: LevelProblem, rows: ActiveRows, active: Int[Array, " h"], x: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return the shortest step that brings the active rows to their bounds."""
    bound = jnp.where(active < 0, problem.lower, problem.upper)[rows.index]
    # bounds that are not active may be infinite: the where on both terms keeps NaN out of values and derivatives
    gap = jnp.where(rows.valid, bound, 0.0) - jnp.where(rows.valid, apply(problem.hard, x)[rows.index], 0.0)
    unit_gap = jnp.where(rows.valid, gap / jnp.where(rows.valid, rows.length, 1.0), 0.0)
    # N d = unit_gap with N = triangle' basis' and d = basis y
    return apply(rows.basis, jax.scipy.linalg.solve_triangular(rows.triangle, unit_gap, trans=1))


def multipliers(problem: LevelProblem, rows: ActiveRows, downhill: Float[Array, " n"]) -> Float[Array, " h"]:
    """Return the multipliers whose combination of active rows is nearest to ``downhill`` in least squares.

    ``downhill`` is the negative gradient of the level's cost, projected onto what is not frozen.
    """
    right = jnp.where(rows.valid, apply(rows.basis.T, downhill), 0.0)
    solved = jax.scipy.linalg.solve_triangular(rows.triangle, right) / jnp.where(rows.valid, rows.length, 1.0)
    return jnp.zeros_like(problem.lower).at[rows.index].set(jnp.where(rows.valid, solved, 0.0))


def drop_dependent(active: Int[Array, " h"], rows: ActiveRows) -> Int[Array, " h"]:
    """Return ``active`` without rows that depend on frozen rows or on other active rows."""
    return jnp.zeros_like(active).at[rows.index].set(jnp.where(rows.valid, active[rows.index], 0))
