"""The hierarchy on a GPU: a kernel goes through all levels, XLA checks the answer, and what is left goes to its own.

The kernel judges each level as ``land`` does, by feasibility and multipliers, from the numbers as they were given. XLA
checks what can be checked without factoring anew: that numbers are finite, hard rows hold, and no level lost its
optimum to those below. The lanes that fail are gathered into blocks and solved level after level by XLA.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._backends import Backend, on_platforms, takes
from .._double import in_double
from .._lanes import in_lanes, with_the_rest
from . import _kernel, _numba
from ._cascade import Descent, certified, descend_all
from ._problem import Tolerances, WorkingSet
from ._stack import Layout, Stack

_BLOCK = 256
"""Lanes that are left are solved this many at a time: XLA's many small kernels cost as much for one as for these."""

_NEARLY = 1e3
"""Feasibility tolerances that an answer may be off its bounds by."""

Solve = Callable[[Layout, Stack, Tolerances, WorkingSet | None, int], Descent]


@cache
def descender(
    layout: Layout, max_iterations: int | None, backend: Backend
) -> Callable[[Stack, Tolerances, WorkingSet | None], Descent]:
    """All levels of one problem, in double precision; a cap on the active-set iterations of one level."""
    cap = 10 * (layout.variables + layout.rows) if max_iterations is None else max_iterations
    return in_lanes(in_double(partial(_descend_anywhere, layout, cap, backend)))


def _descend_anywhere(
    layout: Layout, cap: int, backend: Backend, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None
) -> Descent:
    whole, kernels = partial(descend_all, layout, cap), {}
    if takes(backend, "warp", fits=_kernel.Shape.of(layout).warps > 0):
        kernels["warp"] = partial(descended_and_checked, layout, cap, _kernel.solve)
    if not takes(backend, "numba", fits=True):
        return on_platforms(kernels, whole, stack, tolerances, warm)
    if kernels or jax.default_backend() != "cpu":
        kernels["numba"] = partial(descended_and_checked, layout, cap, _numba.solve)
        return on_platforms(kernels, whole, stack, tolerances, warm)
    # the search is traced once for all platforms, and on those without the kernel nothing is solved before it
    checked = partial(_checked, layout, cap, _numba.solve)
    end = on_platforms({"numba": checked}, partial(_unsolved, checked), stack, tolerances, warm)
    return _with_the_rest(layout, cap, end, stack, tolerances, warm)


def descended_and_checked(
    layout: Layout, cap: int, solve: Solve, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None
) -> Descent:
    """The kernel's answers where they pass the check, XLA's elsewhere; arguments as for ``descend_all``."""
    end = _checked(layout, cap, solve, stack, tolerances, warm)
    return _with_the_rest(layout, cap, end, stack, tolerances, warm)


def _checked(
    layout: Layout, cap: int, solve: Solve, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None
) -> Descent:
    """The kernel's answers, done where they pass the check."""
    end = jax.vmap(certified)(solve(layout, stack, tolerances, warm, cap), stack, tolerances)
    return end._replace(done=end.done & jax.vmap(_holds)(end, stack, tolerances))


def _unsolved(like: Callable[..., Descent], *args: Any) -> Descent:
    """No answer for any lane, in the shapes of those that a function gives."""
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(like, *args))


def _with_the_rest(
    layout: Layout, cap: int, end: Descent, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None
) -> Descent:
    def again(at: Array, end: Descent) -> Descent:
        return descend_all(layout, cap, *jax.tree.map(lambda a: a[at], (stack, tolerances, warm)))

    return with_the_rest(end, end.done, again, min(_BLOCK, len(end.done)))


def _holds(end: Descent, stack: Stack, tolerances: Tolerances) -> Bool[Array, ""]:
    """Whether the numbers are finite, and x is inside its box."""
    n = len(end.x)
    lower, upper = stack.hard_lower[:n], stack.hard_upper[:n]
    near = _NEARLY * tolerances.feasible * (jnp.max(jnp.abs(end.x)) + jnp.abs(end.x))
    inside = (end.x >= lower - near) & (end.x <= upper + near)
    finite = jnp.isfinite(end.x) & inside
    return finite.all() & jnp.isfinite(end.residual) & jnp.isfinite(end.multipliers).all()
