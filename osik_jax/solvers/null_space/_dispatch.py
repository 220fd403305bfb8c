"""Choice of backend for the classical projection: the core solves all levels of one problem after another.

``core/null_space.hpp`` computes what ``_projection.py`` defines, in double precision, on a CPU or a GPU; nothing is
searched, so nothing is certified. That file is the definition, what runs elsewhere, and the derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core import _library
from ...execution._backends import Backend, on_platforms, takes
from ...execution._lanes import in_lanes
from ...execution._rules import custom_jvp
from .._damping import Damping
from ..hqp import Level
from . import _cuda
from ._projection import solve_forward

Answer = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""Answer x, and the projector onto the null space of all levels."""


def project(
    levels: Sequence[Level], secondary: Float[Array, " n"], damping: Damping, rank_tol: Array | float, backend: Backend
) -> Answer:
    """Return the result of ``solve_forward``, by the kernel if available; the damping has an axis of levels."""
    rank_tol = jnp.asarray(rank_tol, secondary.dtype)
    if takes(backend, "core", fits=True):
        return _by_kernel(list(levels), secondary, damping, rank_tol, backend=backend)
    return _plain(list(levels), secondary, damping, rank_tol, backend=backend)


def _plain(levels: list[Level], secondary: Array, damping: Damping, rank_tol: Array, *, backend: Backend) -> Answer:
    each = [Damping(*parts) for parts in zip(*damping, strict=True)]
    return solve_forward(levels, secondary, each, rank_tol, backend)


@custom_jvp
def _by_kernel(levels: list[Level], secondary: Array, damping: Damping, rank_tol: Array, *, backend: Backend) -> Answer:
    return _on_platform(backend)(levels, secondary, damping, rank_tol)


@_by_kernel.defjvp
def _by_kernel_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[Answer, Answer]:
    return jax.jvp(partial(_plain, backend=backend), primals, tangents)


@cache
def _on_platform(backend: Backend) -> Callable[[list[Level], Array, Damping, Array], Answer]:
    """Return the function that solves one problem on the current platform."""
    plain = jax.vmap(partial(_plain, backend=backend))

    def solve(levels: list[Level], secondary: Float[Array, "B n"], *rest: Any) -> Any:
        kernels: dict[str, Callable[..., Any]] = dict(core=partial(_by_core, _library.call))
        rows = tuple(level.matrix.shape[1] for level in levels)
        if takes(backend, "core-cuda", fits=_cuda.fits(secondary.shape[1], rows)):
            kernels["core-cuda"] = partial(_by_core, _cuda.project)
        return on_platforms(kernels, plain, levels, secondary, *rest)

    return in_lanes(solve)


def _by_core(
    call: Callable[..., list[Array]],
    levels: list[Level],
    secondary: Float[Array, "B n"],
    damping: Damping,
    rank_tol: Float[Array, " B"],
) -> tuple[Float[Array, "B n"], Float[Array, "B n n"]]:
    batch, n = secondary.shape
    equal = [jax.vmap(lambda one: one.equal)(level) for level in levels]
    rows = [a for level, e in zip(levels, equal, strict=True) for a in (level.matrix, level.lower, level.upper, e)]
    outputs = [((batch, n), float), ((batch, n, n), float)]
    x, projector = call("projection", outputs, secondary, *damping, rank_tol, *rows)
    return x, projector
