"""The classical order on a CPU: a kernel goes through all levels of a problem at once.

It computes what ``_projection.py`` says, a lane at a time and in double precision; that file is the definition, what
runs elsewhere, and the derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._rules import custom_jvp
from .._backends import Backend, on_platforms, takes
from .._damping import Damping
from .._lanes import in_lanes
from ..hqp import Level
from ..kernels.numba import _target
from ._projection import solve_forward

End = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""The answer, and the projector onto what no level asks for."""


def project(
    levels: Sequence[Level], secondary: Float[Array, " n"], damping: Damping, rank: Array | float, backend: Backend
) -> End:
    """As ``solve_forward``, by the kernel where there is one; the fields of the damping have an axis of levels."""
    rank = jnp.asarray(rank, secondary.dtype)
    if takes(backend, "numba", fits=True):
        return _by_kernel(list(levels), secondary, damping, rank, backend=backend)
    return _plain(list(levels), secondary, damping, rank, backend=backend)


def _plain(levels: list[Level], secondary: Array, damping: Damping, rank: Array, *, backend: Backend) -> End:
    each = [Damping(*parts) for parts in zip(*damping, strict=True)]
    return solve_forward(levels, secondary, each, rank, backend)


@custom_jvp
def _by_kernel(levels: list[Level], secondary: Array, damping: Damping, rank: Array, *, backend: Backend) -> End:
    return _projected(backend)(levels, secondary, damping, rank)


@_by_kernel.defjvp
def _by_kernel_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[End, End]:
    return jax.jvp(partial(_plain, backend=backend), primals, tangents)


@cache
def _projected(backend: Backend) -> Callable[[list[Level], Array, Damping, Array], End]:
    """The function of one problem."""
    plain = jax.vmap(partial(_plain, backend=backend))
    return in_lanes(partial(on_platforms, dict(numba=_by_numba), plain))


def _by_numba(
    levels: list[Level], secondary: Float[Array, "B n"], damping: Damping, rank: Float[Array, " B"]
) -> tuple[Float[Array, "B n"], Float[Array, "B n n"]]:
    lanes, n = secondary.shape
    most = max(level.lower.shape[1] for level in levels)
    r = min(most, n)
    space = (n + 11) * (n + most) + 2 * most**2 + r * (most + 2 * r)  # as Work has it
    equal = [jax.vmap(lambda one: one.equal)(level) for level in levels]
    rows = [a for level, e in zip(levels, equal, strict=True) for a in (level.matrix, level.lower, level.upper, e)]
    shapes = (lanes, n), (lanes, n, n), (space,)
    x, projector, _ = _target.call("_projection", [(s, float) for s in shapes], secondary, *damping, rank, *rows)
    return x, projector
