"""Many searches on a fixed number of lanes: a lane whose search ends takes the next one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..execution._lanes import first_set

TRIAL = 8
"""Steps that every search may take before it has to make progress."""
PROGRESS = 0.7
"""A search goes on where a few steps have brought the cost below this, relative to what it was."""
CHECK = 4
"""Steps between two looks at how the searches are doing."""


class Errors(NamedTuple):
    """Errors of configurations."""

    position: Float[Array, "..."]  # largest of the distances [m]
    orientation: Float[Array, "..."]  # largest of the angles [rad]
    score: Float[Array, "..."]  # largest error relative to its tolerance: 1 and less is converged
    cost: Float[Array, "..."]  # what the steps reduce


def stepped(
    step: Callable[[Array], tuple[Array, Errors]], x: Float[Array, "..."], lanes: int, steps: Any
) -> tuple[Array, Array, Errors]:
    """Return start and end of the last of some steps, and the errors at its start, for a number of lanes."""

    def once(_: Array, carry: tuple[Array, Array, Errors]) -> tuple[Array, Array, Errors]:
        return carry[1], *step(carry[1])

    return jax.lax.fori_loop(0, steps, once, (x, x, Errors(*[jnp.zeros(lanes, x.dtype)] * 4)))


@runtime_checkable
class Search(Protocol):
    """Base class of a search: a pytree whose methods take arrays with a leading axis of lanes."""

    def begin(self, seed: Int[Array, " lanes"], goal: Any) -> Float[Array, "lanes n"]:
        """Return the starts of the searches with these indices."""
        ...

    def advance(self, x: Float[Array, "lanes n"], goal: Any, steps: Any) -> tuple[Array, Array, Errors]:
        """Return the state after some steps: start and end of the last one, and the errors at its start."""
        ...


class Found(NamedTuple):
    """Best result of each target's searches."""

    x: Float[Array, "targets n"]  # coordinates
    errors: Errors  # there
    seed: Int[Array, " targets"]  # number of the search
    steps: Int[Array, " targets"]  # that the target's searches took, all together


class _Lanes(NamedTuple):
    x: Float[Array, "lanes n"]
    target: Int[Array, " lanes"]  # one past the last: idle
    seed: Int[Array, " lanes"]
    age: Int[Array, " lanes"]
    cost: Float[Array, " lanes"]  # at the last look


class _State(NamedTuple):
    lanes: _Lanes
    found: Found
    started: Int[Array, " targets"]
    cursor: Int[Array, ""]


def run_pool(
    search: Search,
    goals: Any,
    open_: Bool[Array, " targets"],
    *,
    lanes: int,
    check: int,
    seeds: Int[Array, " targets"],
    longest: Int[Array, ""],
    enough: Float[Array, ""],
) -> Found:
    """Search for all targets until each is found or has used all its seeds.

    Deterministic: which search a lane takes up depends on nothing but the arguments.

    Args:
        open_: targets that are looked for; the others, which fill up a batch, are left alone.
        lanes: searches that go on at the same time.
        check: steps between two looks at how they are doing.
        seeds: searches for each target at most, one number each.
        longest: steps of one search at most.
        enough: score at which a target is found and its searches end.
    """
    targets = len(open_)
    size = jax.eval_shape(search.begin, jnp.zeros(lanes, jnp.int32), _of(goals, jnp.zeros(lanes, jnp.int32)))
    state = _first_state(size, targets, lanes)

    def body(state: _State) -> _State:
        state = _refill(search, goals, open_, seeds, enough, state)
        here, there, errors = search.advance(state.lanes.x, _of(goals, state.lanes.target), check)
        found = _best(state.found, state.lanes, here, errors, check)
        lanes = _culled(state.lanes, there, errors, found, check, longest, enough)
        return state._replace(lanes=lanes, found=found)

    def goes_on(state: _State) -> Array:
        return (state.lanes.target < targets).any() | _wanting(state, open_, seeds, enough).any()

    found = jax.lax.while_loop(goes_on, body, state).found
    return jax.tree.map(lambda a: a[:-1], found)


def _of(goals: Any, target: Int[Array, " lanes"]) -> Any:
    """Return the goal of each lane; idle lanes have the last goal."""
    return jax.tree.map(lambda a: jnp.take(a, target, axis=0, mode="clip"), goals)


def _first_state(size: Any, targets: int, lanes: int) -> _State:
    """Return the initial state with idle lanes. Arrays over targets have one more row for idle lanes."""
    worst = jnp.full(targets + 1, jnp.inf, size.dtype)
    none = jnp.zeros(targets + 1, jnp.int32)
    idle = jnp.zeros(lanes, jnp.int32)
    return _State(
        _Lanes(jnp.zeros(size.shape, size.dtype), idle + targets, idle, idle, jnp.zeros(lanes, size.dtype)),
        Found(jnp.zeros((targets + 1, size.shape[1]), size.dtype), Errors(worst, worst, worst, worst), none, none),
        none,
        jnp.zeros((), jnp.int32),
    )


def _wanting(state: _State, open_: Array, seeds: Array, enough: Array) -> Bool[Array, " targets"]:
    """Return which targets need another search."""
    return open_ & (state.started[:-1] < seeds) & (state.found.errors.score[:-1] > enough)


def _refill(search: Search, goals: Any, open_: Array, seeds: Array, enough: Array, state: _State) -> _State:
    """Give idle lanes new searches for the targets that need one, in turn."""
    targets = len(open_)
    wanting = _wanting(state, open_, seeds, enough)
    rank = jnp.cumsum(wanting, dtype=jnp.int32)
    count = rank[-1]
    free = state.lanes.target >= targets
    turn = jnp.cumsum(free, dtype=jnp.int32) - 1  # of each free lane among them
    before = jnp.where(state.cursor > 0, rank[jnp.maximum(state.cursor - 1, 0)], 0)
    some = jnp.maximum(count, 1)
    chosen = first_set(wanting, targets)[(before + turn) % some]
    seed = state.started[jnp.minimum(chosen, targets)] + turn // some
    takes = free & (count > 0) & (seed < jnp.take(seeds, chosen, mode="clip"))
    target = jnp.where(takes, chosen, state.lanes.target)
    last = jnp.max(jnp.where(takes & (turn == jnp.sum(takes, dtype=jnp.int32) - 1), chosen, -1))
    start = search.begin(seed, _of(goals, target))
    return state._replace(
        lanes=_Lanes(
            x=jnp.where(takes[:, None], start, state.lanes.x),
            target=target,
            seed=jnp.where(takes, seed, state.lanes.seed),
            age=jnp.where(takes, 0, state.lanes.age),
            cost=jnp.where(takes, jnp.inf, state.lanes.cost),
        ),
        started=state.started.at[jnp.where(takes, chosen, targets)].add(1),
        cursor=jnp.where(last >= 0, (last + 1) % targets, state.cursor).astype(jnp.int32),
    )


def _best(found: Found, lanes: _Lanes, x: Array, errors: Errors, check: int) -> Found:
    """Update the best result of each target; ties keep the present result, then the lowest lane."""
    least = found.errors.score.at[lanes.target].min(errors.score)
    number = jnp.arange(len(lanes.target), dtype=jnp.int32)
    wins = (errors.score == least[lanes.target]) & (errors.score < found.errors.score[lanes.target])
    none = jnp.full(found.seed.shape, len(number), jnp.int32)
    winner = none.at[lanes.target].min(jnp.where(wins, number, len(number)))
    wins &= winner[lanes.target] == number
    # each target is written by one lane only, because the order of colliding writes is undefined on a GPU
    row = jnp.where(wins, lanes.target, len(found.seed))  # out of range: dropped

    def put(old: Array, new: Array) -> Array:
        return old.at[row].set(new, mode="drop")

    return Found(
        put(found.x, x),
        Errors(*(put(old, new) for old, new in zip(found.errors, errors, strict=True))),
        put(found.seed, lanes.seed),
        found.steps.at[lanes.target].add(check),
    )


def _culled(lanes: _Lanes, x: Array, errors: Errors, found: Found, check: int, longest: Array, enough: Array) -> _Lanes:
    """End searches whose target is found, that are too long, or that make no progress."""
    age = lanes.age + check
    # the negated comparison also ends a search whose cost is NaN
    stuck = (age > TRIAL) & ~(errors.cost < PROGRESS * lanes.cost)
    ends = stuck | (age >= longest) | (found.errors.score[lanes.target] <= enough)
    idle = len(found.seed) - 1
    return _Lanes(x, jnp.where(ends, idle, lanes.target), lanes.seed, age, errors.cost)
