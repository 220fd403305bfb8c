"""Implicit derivative of the result of a search."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float

from ..execution._rules import custom_jvp


@custom_jvp
def attached(x: Float[Array, " n"], search: Any, goal: Any) -> Float[Array, " n"]:
    """Return x unchanged, with its derivative by the problem that it solves.

    Where ``error(x, problem) = 0``, the implicit function theorem gives ``J dx = -d error``: of all such dx the
    shortest, over the coordinates that stand at no limit; those that do move with their limit. That is the derivative
    of one Newton step from x, which is what is differentiated here.
    """
    del search, goal
    return x


@attached.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    start, *problem = primals
    x = attached(start, *problem)
    step, moved = jax.jvp(lambda search, goal: search.newton_step(x, goal), tuple(problem), tuple(tangents[1:]))
    del step
    return x, moved
