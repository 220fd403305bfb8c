"""Implicit derivative of the result of a search."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
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
    return x


@custom_jvp
def errors_at(sizes: Float[Array, "2"], x: Float[Array, " n"], search: Any, goal: Any) -> Float[Array, "2"]:
    """Return the position error [m] and the orientation error [rad] unchanged, with their derivatives at x."""
    return sizes


@errors_at.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    (sizes, x, search, goal), (_, rate, *rates) = primals, tangents
    error, matrix = search.rows_at(x, goal)
    _, aside = jax.jvp(lambda search, goal: search.rows_at(x, goal)[0], (search, goal), tuple(rates))
    moved = aside + jnp.matmul(matrix, rate, precision="highest")
    return errors_at(sizes, x, search, goal), jax.jvp(search.sizes, (error,), (moved,))[1]


@attached.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    start, search, goal = primals
    x = attached(start, search, goal)
    return x, search.moved(x, goal, tangents[1:])
