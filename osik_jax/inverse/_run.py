"""Searches for many targets: as many as each target needs, or a fixed number for each."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..execution._blocks import in_blocks
from ..execution._platform import cuda_is_default
from ..robot import Robot
from ._chain_problem import ENOUGH, Settings
from ._closest import Closest, closest
from ._fixed import LAST, Explored, Outcomes, Searches, choose, or_far, or_plain, search_all, with_placeholders
from ._host import in_chunks, lanes_for, only
from ._packed import Packed, call_packed, packed, unpacked
from ._pool import CHECK, Errors, run_pool
from ._solution import InverseKinematicsSolution
from ._task_minimum import settled
from ._whole import whole, whole_is_possible

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
    wanted: Bool[np.ndarray, " targets"] | None = None,
) -> InverseKinematicsSolution:
    """Run as many searches as each target needs; with a start configuration, that search alone first.

    ``go_on``: to the configuration with the least error, for targets that are not met. ``wanted``: the targets that are
    searched for; default: all.
    """
    count, hopeless = len(jax.tree.leaves(goals)[0]), 1 if go_on else _HOPELESS
    lanes, by_core = lanes_for(count), whole_is_possible(route, every=False)

    def search(most: int, goals: Any, left: np.ndarray) -> InverseKinematicsSolution:
        if by_core:
            counts, how = np.where(left, most, 0), Searches(0, warm, near=False, every=False)
            return whole(robot, route, goals, settings, counts, hopeless, steps, how, single=False).answer
        run = partial(_pooled, robot, route=route, warm=warm, lanes=lanes)
        return call_packed(run, goals, settings, left, np.int32(most), np.int32(hopeless), np.int32(steps))

    def chunk(goals: Any, wanted: np.ndarray) -> InverseKinematicsSolution:
        alone = warm and not by_core
        found = jax.device_get(search(1 if alone else seeds, goals, wanted))
        left = wanted & ~found.converged
        if alone and left.any():
            found = _with(found, left, search(seeds, goals, left))
            left &= ~found.converged
        return further(goals, found, left)

    def further(goals: Any, found: InverseKinematicsSolution, left: np.ndarray) -> InverseKinematicsSolution:
        if not (go_on and left.any()):
            return found
        starts = min(seeds, _STARTS)
        approach = partial(_approached, robot, route=route, warm=warm, starts=starts)
        own = only(left, partial(call_packed, approach, settings), goals, found.q, found.seed, found.steps)
        return _with(found, left, own)

    if by_core and cuda_is_default() and wanted is None:  # all targets at once, whose answers stay on the GPU
        found = search(seeds, goals, np.ones(count, bool))
        missed = ~np.asarray(found.converged)
        return further(goals, jax.device_get(found), missed) if missed.any() else found
    wanted = np.ones(count, bool) if wanted is None else wanted
    return in_chunks(lambda given, here: chunk(given[0], here & given[1]), (goals, wanted))


def found_at_once(
    robot: Robot, goals: Any, settings: Settings, seeds: int, steps: int, how: Searches, *, route: Any
) -> Explored | None:
    """Return the results for one target by one call of the core, None if more has to be done for it.

    The answer has no axis of targets; the ends of the searches have.
    """
    found, score, ends, *_ = whole(robot, route, goals, settings, np.array([seeds]), 1, steps, how, single=True)
    if not (found.converged and (score is None or score <= ENOUGH)):
        return None
    return with_ends(found, None if ends is None else np.asarray(ends)[None])


def explored_by_core(
    robot: Robot, goals: Any, *, most: int, settings: Settings, how: Searches, steps: int, route: Any, go_on: bool
) -> Explored:
    """Return what ``explored`` does. Only targets that go on to the least error are computed by it."""
    count = np.full(len(goals.position), most)
    results = whole(robot, route, goals, settings, count, most, steps, how, single=False)
    found, score, ends, *_ = jax.tree.map(np.asarray, results)
    further = ~(score <= ENOUGH)
    if go_on and further.any():
        run = partial(explored, robot, settings=settings, how=how._replace(every=False), steps=steps, route=route)
        by_jax = only(further, lambda goals: run(goals, go_on=True, fall_back=False).found, goals)
        kept = found.converged & how.near & (_distances(found, settings) < _distances(by_jax, settings))
        found = _with(found, further & ~kept, by_jax)
    return with_ends(found, ends)


def with_ends(found: InverseKinematicsSolution, ends: Any) -> Explored:
    """Return answers with the ends of all searches by ``whole``, if there are any."""
    if ends is None:
        return Explored(found)
    return Explored(found, Outcomes(ends[..., :-2], Errors(*[ends[..., -2]] * 4)), ends[..., -1] > 0.0)


def isolated_at_answers(
    robot: Robot, goals: Any, settings: Settings, explored: Explored, *, route: Any
) -> Bool[np.ndarray, " targets"]:
    """Return of each answer whether it is an isolated solution."""
    found, score, isolated = explored.found, explored.outcomes.errors.score, np.asarray(explored.isolated)
    at = np.arange(len(isolated)), np.minimum(found.seed, isolated.shape[1] - 1)
    # where no search of these has met the target, the answer is from a further one, whose numbers begin at 0 again
    known = ~np.asarray(found.converged) | (np.asarray(score)[at] <= 1.0)
    if known.all():
        return isolated[at]
    alone = only(~known, partial(_isolated, robot, settings=settings, route=route), goals, found.q)
    return np.where(known, isolated[at], alone)


@partial(jax.jit, static_argnames="route")
def _isolated(robot: Robot, goals: Any, q: Array, *, settings: Settings, route: Any) -> Array:
    search = route.search(robot, settings, warm=False, near=False)
    return search.isolated(q[:, route.entries(robot)], goals)


def searched_on(
    robot: Robot,
    goals: Any,
    settings: Settings,
    found: InverseKinematicsSolution,
    seeds: int,
    steps: int,
    *,
    route: Any,
    warm: bool,
    near: bool,
) -> InverseKinematicsSolution:
    """Return ``found``; for targets that it has not met, what ``searched`` finds, moved home where ``near``.

    A pull towards home can keep a search from any solution. So where ``near`` the targets that are met are searched for
    as well, and the nearer answer is kept, unless the core has done so.
    """
    near = near and route.starts_anew
    reachable, met = np.asarray(found.beyond_reach) <= 0.0, np.asarray(found.converged)
    left = reachable & ~(met & (not near or whole_is_possible(route, every=True)))
    if not left.any():
        return found
    new = searched(robot, goals, settings, seeds, steps, route=route, warm=warm, go_on=False, wanted=left)
    new = dataclasses.replace(new, steps=found.steps + new.steps)
    left &= np.asarray(new.converged)
    if near and left.any():
        walk = partial(_walked_home, robot, route=route, steps=steps)
        home = only(left, partial(call_packed, walk, settings), goals, new.q, new.seed, new.steps)
        new = _with(new, np.asarray(home.converged) & (_distances(home, settings) < _distances(new, settings)), home)
    return _with(found, left & ~(met & (_distances(found, settings) <= _distances(new, settings))), new)


def _distances(found: InverseKinematicsSolution, settings: Settings) -> Float[np.ndarray, " targets"]:
    """Return how far the answers are from the first configuration."""
    return np.linalg.norm(np.asarray(found.q) - np.asarray(settings.home), axis=1)


def _with(found: Any, changed: np.ndarray, new: Any) -> Any:
    return jax.tree.map(lambda a, b: np.where(changed.reshape(-1, *[1] * (a.ndim - 1)), b, a), found, new)


@partial(jax.jit, static_argnames=("route", "warm", "lanes"))
def _pooled(robot: Robot, given: Packed, *, route: Any, warm: bool, lanes: int) -> Packed:
    goals, settings, wanted, seeds, hopeless, longest = unpacked(given)
    goals, valid = with_placeholders(goals)
    search = route.search(robot, settings, warm=warm, near=False)
    most = jnp.where(route.beyond(search, goals) > 0.0, jnp.minimum(seeds, hopeless), seeds)
    limits = dict(seeds=most, longest=longest, enough=search.enough)
    found = run_pool(search, goals, wanted, lanes=lanes, check=CHECK, **limits)
    return packed(or_far(route.answer(robot, search, goals, found.x, found.seed, found.steps), valid))


@partial(jax.jit, static_argnames=("route", "warm", "starts"))
def _approached(robot: Robot, given: Packed, *, route: Any, warm: bool, starts: int) -> Packed:
    """Return the least-error configuration for unmet targets, from new searches and the best so far."""
    settings, goals, q, seed, before = unpacked(given)
    goals, valid = with_placeholders(goals)
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
    return packed(or_far(route.answer(robot, search, goals, found.x, number, steps), valid))


@partial(jax.jit, static_argnames=("route", "steps"))
def _walked_home(robot: Robot, given: Packed, *, route: Any, steps: int) -> Packed:
    """Return the solutions, moved towards the first configuration by what the frames leave free."""
    settings, goals, q, seed, before = unpacked(given)
    search = route.search(robot, settings, warm=True, near=True)
    starts, last = q[:, None, route.entries(robot)], search.finishing(exact=False)
    x = search_all(search, goals, seeds=1, steps=steps, last=last, starts=starts).x[:, 0]
    return packed(route.answer(robot, search, goals, x, seed, before + steps + LAST))


@partial(jax.jit, static_argnames=("how", "route", "steps", "go_on", "fall_back"))
def explored(
    robot: Robot, goals: Any, *, settings: Settings, how: Searches, route: Any, steps: int, go_on: bool, fall_back: bool
) -> Explored:
    """Return the results of all searches of each target.

    It is a pure function of a limited amount of work. ``fall_back``: on plain searches, where ``near`` meets no target.
    """
    seeds, warm, near, every = how
    goals, valid = with_placeholders(goals)
    search = route.search(robot, settings, warm=warm, near=near)
    fixed_search, fixed_goals = jax.lax.stop_gradient((search, goals))
    last = fixed_search.finishing(exact=every) if near or every else None

    def some(goals: Any) -> tuple[Outcomes, Array | None, Closest]:
        outcomes = search_all(fixed_search, goals, seeds=seeds, steps=steps, last=last)
        if fall_back and route.starts_anew:
            outcomes = or_plain(fixed_search, goals, outcomes, seeds=seeds, steps=steps)
        outcomes = outcomes._replace(x=fixed_search.unwound(outcomes.x))
        each = jax.tree.map(lambda a: jnp.repeat(a, seeds, 0), goals)
        x = outcomes.x.reshape(-1, outcomes.x.shape[-1])
        alone = fixed_search.isolated(x, each).reshape(-1, seeds) if every else None
        away = jax.vmap(jax.vmap(fixed_search.distance))(outcomes.x) if near else None
        best = choose(outcomes, away)
        x = jnp.take_along_axis(outcomes.x, best[:, None, None], 1)[:, 0]
        score = jnp.take_along_axis(outcomes.errors.score, best[:, None], 1)[:, 0]
        unmet, loose = score > 1.0, score > fixed_search.enough
        if not go_on:
            return outcomes, alone, Closest(x, jnp.zeros_like(score), best, jnp.zeros_like(best))
        if not route.starts_anew:
            rest, more = settled(fixed_search, x, goals, loose)
            takes = unmet | (jax.vmap(fixed_search.errors)(rest, goals)[1].score <= 1.0)
            return outcomes, alone, Closest(jnp.where(takes[:, None], rest, x), jnp.zeros_like(score), best, more)
        # a solution just out of reach, or singular, goes on too, but from itself, so that it stays on its branch
        starts = jnp.where(unmet[:, None, None], outcomes.x, x[:, None])
        further = closest(fixed_search, goals, starts, loose, near=near)
        takes = unmet | (loose & (further.error <= fixed_search.tolerance[0]))
        x = jnp.where(takes[:, None], further.x, x)
        seed, more = jnp.where(unmet, further.seed, best), jnp.where(loose, further.steps, 0)
        return outcomes, alone, Closest(x, further.error, seed, more)

    outcomes, alone, found = in_blocks(some, (fixed_goals,), _TOGETHER)
    taken = seeds * (steps + (0 if last is None else LAST)) + found.steps
    answer = route.answer(robot, search, goals, found.x, found.seed, taken)
    return Explored(or_far(answer, valid), outcomes, alone)
