"""Implicit derivative of the result of a search."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from ..execution._rules import custom_jvp


@custom_jvp
def attached(x: Float[Array, " n"], search: Any, goal: Any) -> Float[Array, " n"]:
    """Return x unchanged, with its derivative by the problem that it solves.

    Where ``error(x, problem) = 0``, the implicit function theorem gives ``J dx = -d error``: of all such dx the
    shortest, over the coordinates that stand at no limit; those that do move with their limit. That is the derivative
    of one Newton step from x. Where the error is least and not 0, its gradient is 0, and ``H dx = -d gradient`` with
    the Hessian H of half the squared error.
    """
    del search, goal
    return x


@attached.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    start, search, goal = primals
    x = attached(start, search, goal)
    return x, search.moved(x, goal, tangents[1:])
