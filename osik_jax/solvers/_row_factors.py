"""An orthonormal basis of what rows span, the most independent row first, and what inverts the rows on it.

Modified Gram-Schmidt with the longest row that is left as the pivot (A. Bjorck, "Numerics of Gram-Schmidt
orthogonalization", Linear Algebra and its Applications 197, 1994); each new direction is orthogonalised twice, after
which it is orthogonal to rounding. On the way the columns of the rows on the new basis are orthogonalised as well, with
the root of the damping below them. A batch goes through together, and a pass is a few products with a vector a row: a
GPU, for which LAPACK's factorisations are many calls, computes hundreds of them in the time of one of those. On a CPU
a kernel does the same a lane at a time (``kernels/numba/_row_factors.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._backends import Backend, on_platforms, takes
from ._dense import apply
from ._double import first_smallest
from ._lanes import in_lanes
from .kernels.numba import _target


class RowFactors(NamedTuple):
    """matrix = left triangle basis for the rows that count, left being the first m rows of ``outer``."""

    basis: Float[Array, "m n"]  # orthonormal rows, 0 from the rank on
    outer: Float[Array, "k m"]  # orthonormal columns; k = 2 m, the second half is that of the damping
    triangle: Float[Array, "m m"]  # upper triangular, the identity from the rank on


class _State(NamedTuple):
    rest: Float[Array, "m n"]  # the rows without what the basis spans
    basis: Float[Array, "m n"]
    outer: Float[Array, "k m"]
    triangle: Float[Array, "m m"]
    rank: Int[Array, ""]
    goes_on: Bool[Array, ""]


def row_factors(
    matrix: Float[Array, "m n"], cutoff: Float[Array, ""], damping: Float[Array, ""], backend: Backend = "jax"
) -> RowFactors:
    """Factors of [matrix on its basis; sqrt(damping) I]; rows that stand out by no more than the cutoff do not count.

    Not differentiable. ``backend`` as ``here`` says it (``_backends.py``).
    """
    return _factored(backend)(matrix, cutoff, damping)


@cache
def _factored(backend: Backend) -> Callable[[Array, Array, Array], RowFactors]:
    """The function of one problem."""
    return in_lanes(partial(_factors_anywhere, backend))


def _factors_anywhere(backend: Backend, matrix: Array, cutoff: Array, damping: Array) -> RowFactors:
    fits = matrix.shape[1] > 0
    kernels = {"numba": _by_numba} if fits and takes(backend, "numba", fits=True) else {}
    return on_platforms(kernels, _factors, matrix, cutoff, damping)


def _by_numba(matrix: Float[Array, "B m n"], cutoff: Float[Array, " B"], damping: Float[Array, " B"]) -> RowFactors:
    lanes, m, n = matrix.shape
    shapes = (lanes, m, n), (lanes, 2 * m, m), (lanes, m, m), (m * (n + 2 * m),)
    outputs = [(shape, float) for shape in shapes]
    return RowFactors(*_target.call("_row_factors", outputs, matrix, cutoff, damping)[:3])


def _factors(matrix: Float[Array, "B m n"], cutoff: Float[Array, " B"], damping: Float[Array, " B"]) -> RowFactors:
    count, m, _ = matrix.shape
    nothing = jnp.zeros((count, 2 * m, m), matrix.dtype)
    triangle = jnp.broadcast_to(jnp.eye(m, dtype=matrix.dtype), (count, m, m))
    none = jnp.zeros(count, jnp.int32)
    start = _State(matrix, jnp.zeros_like(matrix), nothing, triangle, none, none == 0)
    root = jnp.sqrt(damping)
    if not m:
        return RowFactors(start.basis, start.outer, start.triangle)
    end = jax.lax.while_loop(lambda s: jnp.any(s.goes_on), lambda s: jax.vmap(_next_direction)(cutoff, root, s), start)
    return RowFactors(end.basis, end.outer, end.triangle)


def _next_direction(cutoff: Float[Array, ""], root: Float[Array, ""], s: _State) -> _State:
    here = jnp.arange(len(s.basis)) == s.rank
    row = s.rest[first_smallest(-jnp.sum(s.rest**2, -1))]
    row = row - apply(s.basis.T, apply(s.basis, row))
    length = jnp.sqrt(jnp.sum(row**2))
    counts = s.goes_on & (length > cutoff) & here.any()
    direction = jnp.where(counts, row / jnp.where(counts, length, 1.0), 0.0)
    own = apply(s.rest, direction)
    column, shares = jnp.concatenate([own, jnp.where(here & counts, root, 0.0)]), jnp.zeros_like(own)
    for _ in range(2):
        more = apply(s.outer.T, column)
        column, shares = column - apply(s.outer, more), shares + more
    size = jnp.where(counts, jnp.sqrt(jnp.sum(column**2)), 1.0)
    here &= counts
    return _State(
        rest=s.rest - own[:, None] * direction,
        basis=jnp.where(here[:, None], direction, s.basis),
        outer=jnp.where(here, (column / size)[:, None], s.outer),
        triangle=jnp.where(here, (shares + jnp.where(here, size, 0.0))[:, None], s.triangle),
        rank=s.rank + counts,
        goes_on=counts,
    )
