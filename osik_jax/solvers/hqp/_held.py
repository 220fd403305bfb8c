"""Rows that are held at a bound: orthonormal factors of them inside the null space of what is frozen."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from ._stack import Task


class Held(NamedTuple):
    """N' = basis triangle for the unit rows N that are held, the most independent first."""

    rows: Int[Array, " n"]  # their indices
    valid: Bool[Array, " n"]  # held, and independent of frozen rows and of those before
    length: Float[Array, " n"]
    basis: Float[Array, "n n"]  # orthonormal columns, 0 where not valid
    triangle: Float[Array, "n n"]  # upper triangular, the identity where not valid
    projector: Float[Array, "n n"]  # on the null space of frozen and held rows


def hold(task: Task, side: Int[Array, " h"], rank: Array | float) -> Held:
    """Factors of the hard rows with a side, within the null space of the frozen ones."""
    n = len(task.x)
    wanted = side != 0
    first = jnp.argsort(~wanted, stable=True)[:n]
    length = task.length[first]
    unit = jnp.where(wanted[first], 1.0 / jnp.where(length > 0.0, length, 1.0), 0.0)
    normals = product(task.matrix[first] * unit[:, None], task.projector)
    basis, triangle, order = jax.scipy.linalg.qr(normals.T, mode="economic", pivoting=True)
    valid = jnp.abs(jnp.diagonal(triangle)) > rank
    basis = jnp.where(valid, basis, 0.0)
    return Held(
        rows=first[order],
        valid=valid,
        length=length[order],
        basis=basis,
        triangle=jnp.where(valid[:, None] & valid[None, :], triangle, jnp.eye(n, dtype=basis.dtype)),
        projector=task.projector - product(basis, basis.T),
    )


def restoring_step(task: Task, held: Held, side: Int[Array, " h"], x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The shortest step that brings the held rows to their bounds."""
    bound = jnp.where(side < 0, task.lower, task.upper)[held.rows]
    gap = jnp.where(held.valid, bound, 0.0) - jnp.where(held.valid, apply(task.matrix, x)[held.rows], 0.0)
    share = jnp.where(held.valid, gap / jnp.where(held.valid, held.length, 1.0), 0.0)
    return apply(held.basis, jax.scipy.linalg.solve_triangular(held.triangle, share, trans=1))


def multipliers(task: Task, held: Held, downhill: Float[Array, " n"]) -> Float[Array, " h"]:
    """Of the held rows: downhill is their combination with these, as nearly as can be; 0 for the others."""
    right = jnp.where(held.valid, apply(held.basis.T, downhill), 0.0)
    solved = jax.scipy.linalg.solve_triangular(held.triangle, right) / jnp.where(held.valid, held.length, 1.0)
    return jnp.zeros_like(task.lower).at[held.rows].set(jnp.where(held.valid, solved, 0.0))


def independent(task: Task, side: Int[Array, " h"], rank: Array | float) -> Int[Array, " h"]:
    """``side`` without the rows that depend on frozen rows or on other held rows."""
    held = hold(task, side, rank)
    return jnp.zeros_like(side).at[held.rows].set(jnp.where(held.valid, side[held.rows], 0))
