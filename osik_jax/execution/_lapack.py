"""LAPACK calls in a program: which of them jaxlib splits, and the batch size up to which it does not.

Split calls can wait for ever (``_workers.py``). A call is split if its batch size times the operations for one matrix
reaches ``SPLIT``; a batch of 1 is never split.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import prod
from typing import Any, NamedTuple

import jax

SPLIT = 200_000
"""Operations from which on jaxlib 0.10.2 splits a call."""


class Call(NamedTuple):
    """Batched LAPACK call: its number of matrices, and the operations for one matrix."""

    batch: int
    operations: int

    def is_split(self) -> bool:
        """Return whether the call is split into tasks."""
        return self.batch > 1 and self.batch * self.operations >= SPLIT


def lapack_calls(function: Callable[..., Any], *args: Any) -> list[Call]:
    """Return the LAPACK calls in the program of ``function(*args)`` by tracing it with arrays or their shapes."""
    return list(_calls(jax.make_jaxpr(function)(*args).jaxpr))


def lanes_in_one(function: Callable[..., Any], args: tuple[Any, ...], size: int) -> int:
    """Return the largest number of lanes, from 1 to ``size``, for which no LAPACK call is split."""
    block = jax.tree.map(lambda a: jax.ShapeDtypeStruct((size, *a.shape[1:]), a.dtype), args)
    # a call has so many matrices a lane, or those of a few lanes
    split = [call.operations * max(1, call.batch // size) for call in lapack_calls(function, *block) if call.is_split()]
    return min([size, *(max(1, (SPLIT - 1) // operations) for operations in split)])


def _calls(jaxpr: Any) -> Iterator[Call]:
    for equation in jaxpr.eqns:
        count = _OPERATIONS.get(equation.primitive.name)
        if count:
            shapes = [v.aval.shape for v in equation.invars]
            yield Call(prod(shapes[0][:-2]), count(*(shape[-2:] for shape in shapes[:2])))
        for parameter in jax.tree.leaves(list(equation.params.values()), is_leaf=_has_jaxpr):
            if _has_jaxpr(parameter):
                yield from _calls(getattr(parameter, "jaxpr", parameter))


def _has_jaxpr(parameter: Any) -> bool:
    return hasattr(getattr(parameter, "jaxpr", parameter), "eqns")


def _reflections(matrix: tuple[int, int], *_: Any) -> int:
    return 2 * prod(matrix) * min(matrix)


def _rotations(matrix: tuple[int, int], *_: Any) -> int:
    return 9 * prod(matrix) * min(matrix)


_OPERATIONS: dict[str, Callable[..., int]] = {
    "cholesky": lambda matrix: matrix[0] ** 3 // 3,
    "triangular_solve": lambda matrix, right: matrix[0] * prod(right),
    "lu": lambda matrix: prod(matrix) * min(matrix),
    "qr": _reflections,
    "geqrf": _reflections,
    "geqp3": _reflections,
    "householder_product": _reflections,
    "svd": _rotations,
    "eigh": _rotations,
}
"""Operation counts for one matrix, at least those that jaxlib assumes (measured with jaxlib 0.10.2).

Operations that the solvers do not use are missing, such as eigenvalues of unsymmetric matrices.
"""
