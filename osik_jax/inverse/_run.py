"""Searches for many targets: as many as each target needs, or a fixed number for each."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..execution._blocks import in_blocks
from ..robot import Robot
from ._chain_problem import Settings
from ._closest import Closest, closest
from ._fixed import LAST, Outcomes, choose, search_all
from ._host import in_chunks, lanes_for, only
from ._packed import Packed, packed, unpacked
from ._pool import run_pool
from ._solution import InverseKinematicsSolution

_HOPELESS = 16
"""Searches for a target that is known to be out of reach, where the closest configuration is not wanted."""
_TOGETHER = 2
"""Targets whose searches a CPU core goes through together, so that they stay in its cache."""
_STARTS, _GLANCE = 128, 8
"""Searches, and steps of each, of which the best go on to the configuration with the least error."""


def searched(
    robot: Robot,
    goals: Any,
    settings: Settings,
    seeds: int,
    steps: int,
    *,
    route: Any,
    warm: bool,
    go_on: bool,
) -> InverseKinematicsSolution:
    """Run as many searches as each target needs; with a start configuration, that search alone first.

    ``go_on``: to the configuration with the least error, for targets that are not met.
    """
    lanes = lanes_for(len(jax.tree.leaves(goals)[0]), route.pace.lanes)
    run = partial(_pooled, robot, route=route, warm=warm, lanes=lanes)
    hopeless = np.int32(1 if go_on else _HOPELESS)

    def chunk(goals: Any, wanted: np.ndarray) -> InverseKinematicsSolution:
        def by(most: int, left: np.ndarray) -> InverseKinematicsSolution:
            given = packed((goals, settings, left, np.int32(most), hopeless, np.int32(steps)))
            return unpacked(jax.device_get(run(given)))

        found = by(1 if warm else seeds, wanted)
        left = wanted & ~found.converged
        if warm and left.any():
            found = _with(found, left, by(seeds, left))
            left &= ~found.converged
        if not (go_on and left.any()):
            return found
        starts = min(seeds, _STARTS)
        run_on = partial(_approached, robot, route=route, warm=warm, starts=starts)

        def approach(*args: Any) -> InverseKinematicsSolution:
            return unpacked(jax.device_get(run_on(packed((settings, *args)))))

        own = only(left, approach, goals, found.q, found.seed, found.steps)
        return _with(found, left, own)

    return in_chunks(chunk, goals)


def _with(found: Any, changed: np.ndarray, new: Any) -> Any:
    return jax.tree.map(lambda a, b: np.where(changed.reshape(-1, *[1] * (a.ndim - 1)), b, a), found, new)


@partial(jax.jit, static_argnames=("route", "warm", "lanes"))
def _pooled(robot: Robot, given: Packed, *, route: Any, warm: bool, lanes: int) -> Packed:
    goals, settings, wanted, seeds, hopeless, longest = unpacked(given)
    search = route.search(robot, settings, warm=warm, near=False)
    most = jnp.where(route.beyond(search, goals) > 0.0, jnp.minimum(seeds, hopeless), seeds)
    limits = dict(seeds=most, longest=longest, enough=search.enough)
    found = run_pool(search, goals, wanted, lanes=lanes, check=route.pace.check, **limits)
    return packed(route.answer(robot, search, goals, found.x, found.seed, found.steps))


@partial(jax.jit, static_argnames=("route", "warm", "starts"))
def _approached(robot: Robot, given: Packed, *, route: Any, warm: bool, starts: int) -> Packed:
    """Return the least-error configuration for unmet targets, from new searches and the best so far."""
    settings, goals, q, seed, before = unpacked(given)
    search = route.search(robot, settings, warm=warm, near=False)

    def some(goals: Any, best: Array) -> Closest:
        x = best[:, None]
        if route.starts_anew:
            x = jnp.concatenate([search_all(search, goals, seeds=starts, steps=_GLANCE).x, x], 1)
        return closest(search, goals, x, jnp.ones(len(x), bool), near=False)

    found = in_blocks(some, (goals, q[:, route.entries(robot)]), _TOGETHER)
    new = starts if route.starts_anew else 0
    steps = before + new * _GLANCE + found.steps
    number = jnp.where(found.seed == new, seed, found.seed)
    return packed(route.answer(robot, search, goals, found.x, number, steps))


@partial(jax.jit, static_argnames=("route", "seeds", "steps", "warm", "near", "every", "go_on"))
def explored(
    robot: Robot,
    goals: Any,
    *,
    settings: Settings,
    route: Any,
    seeds: int,
    steps: int,
    warm: bool,
    near: bool,
    every: bool,
    go_on: bool,
) -> tuple[InverseKinematicsSolution, Outcomes, Bool[Array, "targets seeds"] | None]:
    """Return the results of all searches of each target; with ``every`` also whether solutions are isolated.

    It is a pure function of a limited amount of work.
    """
    goals, valid = _with_placeholders(goals)
    search = route.search(robot, settings, warm=warm, near=near)
    fixed_search, fixed_goals = jax.lax.stop_gradient((search, goals))
    last = fixed_search.finishing(exact=every) if near or every else None

    def some(goals: Any) -> tuple[Outcomes, Array | None, Closest]:
        outcomes = search_all(fixed_search, goals, seeds=seeds, steps=steps, last=last)
        outcomes = outcomes._replace(x=fixed_search.unwound(outcomes.x))
        each = jax.tree.map(lambda a: jnp.repeat(a, seeds, 0), goals)
        x = outcomes.x.reshape(-1, outcomes.x.shape[-1])
        alone = fixed_search.isolated(x, each).reshape(-1, seeds) if every else None
        away = jax.vmap(jax.vmap(fixed_search.distance))(outcomes.x) if near else None
        best = choose(outcomes, away)
        x = jnp.take_along_axis(outcomes.x, best[:, None, None], 1)[:, 0]
        if not (go_on and route.starts_anew):
            return outcomes, alone, Closest(x, best, jnp.zeros_like(best))
        unmet = jnp.take_along_axis(outcomes.errors.score, best[:, None], 1)[:, 0] > 1.0
        further = closest(fixed_search, goals, outcomes.x, unmet, near=near)
        x = jnp.where(unmet[:, None], further.x, x)
        seed, more = jnp.where(unmet, further.seed, best), jnp.where(unmet, further.steps, 0)
        return outcomes, alone, Closest(x, seed, more)

    outcomes, alone, found = in_blocks(some, (fixed_goals,), _TOGETHER)
    taken = seeds * (steps + (0 if last is None else LAST)) + found.steps
    answer = route.answer(robot, search, goals, found.x, found.seed, taken)
    most = jnp.asarray(jnp.finfo(found.x.dtype).max, found.x.dtype)
    answer = dataclasses.replace(
        answer,
        converged=answer.converged & valid,
        position_error=jnp.where(valid, answer.position_error, most),
        orientation_error=jnp.where(valid, answer.orientation_error, most),
    )
    return answer, outcomes, alone


def _with_placeholders(goals: Any) -> tuple[Any, Bool[Array, " targets"]]:
    """Return the targets with 0 in place of non-finite ones (traced ones may be), and which are valid.

    One so large that the square of a distance may not be finite is not valid.
    """
    numbers, rest = eqx.partition(goals, eqx.is_inexact_array)
    valid = jnp.ones(len(jax.tree.leaves(goals)[0]), bool)
    for leaf in jax.tree.leaves(numbers):
        largest = 1e-3 * jnp.sqrt(jnp.finfo(leaf.dtype).max)
        valid &= (jnp.abs(leaf) <= largest).reshape(len(leaf), -1).all(1)

    def kept(a: Array) -> Array:
        return jnp.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)

    return eqx.combine(jax.tree.map(kept, numbers), rest), valid
