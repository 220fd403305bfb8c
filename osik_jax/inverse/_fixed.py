"""Searches of a fixed length, as a pure function of arrays for traced programs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._implicit import attached
from ._pool import Errors, Search

LAST = 8
"""Steps at the end."""
_SETTLED = 0.1
"""Score of a search that has come to its end; of those the nearest is taken before any that still moves."""


class Outcomes(NamedTuple):
    """End points of all searches of each target.

    Attributes:
        x: coordinates. (targets, seeds, n)
        errors: there. (targets, seeds) each
    """

    x: Float[Array, "targets seeds n"]
    errors: Errors


def search_all(search: Search, goals: Any, *, seeds: int, steps: int, last: Search | None = None) -> Outcomes:
    """Run ``seeds`` searches of ``steps`` steps for each target.

    Args:
        search: the method.
        goals: pytree of the targets, with the targets in front.
        seeds: searches for each target.
        steps: of each.
        last: the method of a few more steps at the end, if another.
    """
    targets = len(jax.tree.leaves(goals)[0])
    number = jnp.tile(jnp.arange(seeds, dtype=jnp.int32), targets)
    lanes = jax.tree.map(lambda a: jnp.repeat(a, seeds, 0), goals)
    at, there, errors = search.advance(search.begin(number, lanes), lanes, steps)
    if last is not None:
        at, _, errors = last.advance(there, lanes, LAST)
    return jax.tree.map(lambda a: a.reshape(targets, seeds, *a.shape[1:]), Outcomes(at, errors))


def choose(outcomes: Outcomes, distance: Float[Array, "targets seeds"] | None) -> Int[Array, " targets"]:
    """Return the number of the best: the nearest of the converged ones, or the first where there are no distances.

    Not the most exact one, which could be any as the target moves. Where none has converged, the least wrong.
    """
    score = jnp.where(jnp.isnan(outcomes.errors.score), jnp.inf, outcomes.errors.score)
    order = jnp.broadcast_to(jnp.arange(score.shape[-1]), score.shape) if distance is None else distance
    best = jnp.argmin(score, -1)
    for bound in (1.0, _SETTLED):
        good = score <= bound
        best = jnp.where(good.any(-1), jnp.argmin(jnp.where(good, order, jnp.inf), -1), best)
    return best.astype(jnp.int32)


def at_solution(search: Any, goal: Any, x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return x, the result of an undifferentiated search, with the derivative of a solution."""
    return attached(jax.lax.stop_gradient(x), search, goal)
