"""Rank-revealing factors of a matrix: orthonormal basis of its row space, and QR factors of its rows on that basis.

Modified Gram-Schmidt with the longest row that is left as the pivot (A. Bjorck, "Numerics of Gram-Schmidt
orthogonalization", Linear Algebra and its Applications 197, 1994); each new direction is orthogonalised twice, after
which it is orthogonal to roundoff ("twice is enough"). On the way the columns of [A basis'; sqrt(damping) I] are
orthogonalised as well. A batch is factored together, one pivot of all problems an iteration, by products with vectors:
on a GPU, LAPACK's factorisations are many calls each. On a CPU the core does the same for one problem after another
(``core/row_factors.hpp``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core import _library
from ..execution._backends import Backend, on_platforms, takes
from ..execution._double import first_smallest
from ..execution._lanes import in_lanes
from ..numerics._dense import apply


class RowFactors(NamedTuple):
    """``[matrix basis'; sqrt(damping) I] = orthonormal triangle`` over the directions up to the rank.

    So ``matrix = left triangle basis`` with ``left`` the first m rows of ``orthonormal``.
    """

    basis: Float[Array, "m n"]  # orthonormal rows, 0 from the rank on
    orthonormal: Float[Array, "k m"]  # columns; k = 2 m, the second half belongs to the damping
    triangle: Float[Array, "m m"]  # upper triangular, the identity from the rank on


class _State(NamedTuple):
    residual: Float[Array, "m n"]  # the rows without what the basis spans
    basis: Float[Array, "m n"]
    orthonormal: Float[Array, "k m"]
    triangle: Float[Array, "m m"]
    rank: Int[Array, ""]
    is_running: Bool[Array, ""]


def row_factors(
    matrix: Float[Array, "m n"], cutoff: Float[Array, ""], damping: Float[Array, ""], backend: Backend = "jax"
) -> RowFactors:
    """Factor rows and damping; the basis ends when the longest residual row is below the cutoff.

    Not differentiable. ``backend`` as ``here`` returns it (``execution/_backends.py``).
    """
    return _factored(backend)(matrix, cutoff, damping)


@cache
def _factored(backend: Backend) -> Callable[[Array, Array, Array], RowFactors]:
    """Return the function that factors one problem."""
    return in_lanes(partial(_factors_anywhere, backend))


def _factors_anywhere(backend: Backend, matrix: Array, cutoff: Array, damping: Array) -> RowFactors:
    fits = matrix.shape[1] > 0
    kernels = {"core": _by_core} if fits and takes(backend, "core", fits=True) else {}
    return on_platforms(kernels, _factors, matrix, cutoff, damping)


def _by_core(matrix: Float[Array, "B m n"], cutoff: Float[Array, " B"], damping: Float[Array, " B"]) -> RowFactors:
    batch, m, n = matrix.shape
    outputs = [(shape, float) for shape in ((batch, m, n), (batch, 2 * m, m), (batch, m, m))]
    return RowFactors(*_library.call("row_factors", outputs, matrix, cutoff, damping))


def _factors(matrix: Float[Array, "B m n"], cutoff: Float[Array, " B"], damping: Float[Array, " B"]) -> RowFactors:
    count, m, _ = matrix.shape
    zeros = jnp.zeros((count, 2 * m, m), matrix.dtype)
    triangle = jnp.broadcast_to(jnp.eye(m, dtype=matrix.dtype), (count, m, m))
    rank = jnp.zeros(count, jnp.int32)
    start = _State(matrix, jnp.zeros_like(matrix), zeros, triangle, rank, rank == 0)
    root = jnp.sqrt(damping)
    if not m:
        return RowFactors(start.basis, start.orthonormal, start.triangle)
    end = jax.lax.while_loop(
        lambda s: jnp.any(s.is_running), lambda s: jax.vmap(_next_direction)(cutoff, root, s), start
    )
    return RowFactors(end.basis, end.orthonormal, end.triangle)


def _next_direction(cutoff: Float[Array, ""], root: Float[Array, ""], s: _State) -> _State:
    """Add one direction to the basis and one column to the QR factors; ``root`` is the root of the damping."""
    at_rank = jnp.arange(len(s.basis)) == s.rank
    # the longest residual row is the pivot, orthogonalised against the basis a second time
    row = s.residual[first_smallest(-jnp.sum(s.residual**2, -1))]
    row = row - apply(s.basis.T, apply(s.basis, row))
    length = jnp.sqrt(jnp.sum(row**2))
    is_independent = s.is_running & (length > cutoff) & at_rank.any()
    direction = jnp.where(is_independent, row / jnp.where(is_independent, length, 1.0), 0.0)
    # the rows along the new direction, above the damping's root, are the next column of the matrix to factor
    along = apply(s.residual, direction)
    column, coefficients = (
        jnp.concatenate([along, jnp.where(at_rank & is_independent, root, 0.0)]),
        jnp.zeros_like(along),
    )
    # Gram-Schmidt, twice: what one pass leaves of the columns before is roundoff after the second
    for _ in range(2):
        correction = apply(s.orthonormal.T, column)
        column, coefficients = column - apply(s.orthonormal, correction), coefficients + correction
    # column = orthonormal coefficients + norm direction: the next column of the triangle
    norm = jnp.where(is_independent, jnp.sqrt(jnp.sum(column**2)), 1.0)
    at_rank &= is_independent
    return _State(
        residual=s.residual - along[:, None] * direction,
        basis=jnp.where(at_rank[:, None], direction, s.basis),
        orthonormal=jnp.where(at_rank, (column / norm)[:, None], s.orthonormal),
        triangle=jnp.where(at_rank, (coefficients + jnp.where(at_rank, norm, 0.0))[:, None], s.triangle),
        rank=s.rank + is_independent,
        is_running=is_independent,
    )
