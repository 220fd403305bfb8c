"""Searches of a fixed length, as a pure function of arrays for traced programs."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._pool import Errors, Search
from ._solution import InverseKinematicsSolution

LAST = 8
"""Steps at the end."""
SETTLED = 0.1
"""Score of a search that has come to its end; of those the nearest is taken before any that still moves."""


class Outcomes(NamedTuple):
    """End points of all searches of each target."""

    x: Float[Array, "targets seeds n"]  # coordinates
    errors: Errors  # there; (targets, seeds) each


class Searches(NamedTuple):
    """Static settings of the searches for a target; hashable."""

    seeds: int  # their number, where all of them run
    warm: bool  # whether search 0 starts at the first configuration
    near: bool  # whether they start around it and go towards it
    every: bool  # whether the results of all of them are wanted


class Explored(NamedTuple):
    """Results of all searches of each target."""

    found: InverseKinematicsSolution  # the best
    outcomes: Any = None  # their ends; None where the core computed the best alone
    isolated: Any = None  # with ``every``, whether these are isolated solutions, else None; (targets, seeds)


def search_all(
    search: Search,
    goals: Any,
    *,
    seeds: int,
    steps: Int[Array, ""] | int,
    last: Search | None = None,
    starts: Float[Array, "targets seeds n"] | None = None,
) -> Outcomes:
    """Run ``seeds`` searches of ``steps`` steps for each target.

    Args:
        steps: of each search; traced where it may be 0, for searches that are not needed.
        last: the method of a few more steps at the end, if another.
        starts: where the searches start. Default: where the method begins.
    """
    targets = len(jax.tree.leaves(goals)[0])
    number = jnp.tile(jnp.arange(seeds, dtype=jnp.int32), targets)
    lanes = jax.tree.map(lambda a: jnp.repeat(a, seeds, 0), goals)
    begin = search.begin(number, lanes) if starts is None else starts.reshape(-1, starts.shape[-1])
    at, there, errors = search.advance(begin, lanes, steps)
    if last is not None:
        at, _, errors = last.advance(there, lanes, LAST if isinstance(steps, int) else jnp.minimum(steps, LAST))
    return jax.tree.map(lambda a: a.reshape(targets, seeds, *a.shape[1:]), Outcomes(at, errors))


def or_plain(search: Any, goals: Any, outcomes: Outcomes, *, seeds: int, steps: int) -> Outcomes:
    """Return the outcomes of searches near home; for targets that none has met, those of plain searches.

    The plain searches then walk home, each as far as it stays a solution. Where all targets are met, no step is taken.
    """
    plain = search.finishing(exact=False)
    unmet = ~(outcomes.errors.score <= 1.0).any(1)
    needed = jnp.where(unmet.any(), steps, 0)
    found = search_all(plain, goals, seeds=seeds, steps=needed)
    home = search_all(search, goals, seeds=seeds, steps=needed, last=plain, starts=found.x)
    walked = home.errors.score <= 1.0

    def chosen(near: Array, walking: Array, away: Array) -> Array:
        kept, missed = (a.reshape(*a.shape, *[1] * (near.ndim - a.ndim)) for a in (walked, unmet))
        return jnp.where(missed, jnp.where(kept, walking, away), near)

    return jax.tree.map(chosen, outcomes, home, found)


def choose(outcomes: Outcomes, distance: Float[Array, "targets seeds"] | None) -> Int[Array, " targets"]:
    """Return the number of the best: the nearest of the converged ones, or the first where there are no distances.

    Not the most exact one, which could be any as the target moves. Where none has converged, the least wrong.
    """
    score = jnp.where(jnp.isnan(outcomes.errors.score), jnp.inf, outcomes.errors.score)
    order = jnp.broadcast_to(jnp.arange(score.shape[-1]), score.shape) if distance is None else distance
    best = jnp.argmin(score, -1)
    for bound in (1.0, SETTLED):
        good = score <= bound
        best = jnp.where(good.any(-1), jnp.argmin(jnp.where(good, order, jnp.inf), -1), best)
    return best.astype(jnp.int32)


def or_far(answer: InverseKinematicsSolution, valid: Bool[Array, " targets"]) -> InverseKinematicsSolution:
    """Return the answer, with the largest finite errors where the target is not valid."""
    most = jnp.asarray(jnp.finfo(answer.q.dtype).max, answer.q.dtype)
    return dataclasses.replace(
        answer,
        converged=answer.converged & valid,
        position_error=jnp.where(valid, answer.position_error, most),
        orientation_error=jnp.where(valid, answer.orientation_error, most),
    )


def with_placeholders(goals: Any) -> tuple[Any, Bool[Array, " targets"]]:
    """Return the targets with 0 in place of NaN and infinity (traced ones may be), and which are valid.

    A target so far away that the square of a distance may not be finite is not valid; a nearer one takes its place.
    """
    numbers, rest = eqx.partition(goals, eqx.is_inexact_array)
    valid = jnp.ones(len(jax.tree.leaves(goals)[0]), bool)

    def largest(a: Array) -> Array:
        return 1e-3 * jnp.sqrt(jnp.finfo(a.dtype).max)

    for leaf in jax.tree.leaves(numbers):
        valid &= (jnp.abs(leaf) <= largest(leaf)).reshape(len(leaf), -1).all(1)

    def kept(a: Array) -> Array:
        near = jnp.clip(jnp.where(jnp.isfinite(a), a, 0.0), -largest(a), largest(a))
        return jnp.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, near)

    return eqx.combine(jax.tree.map(kept, numbers), rest), valid
