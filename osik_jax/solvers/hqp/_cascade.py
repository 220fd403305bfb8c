"""Level after level, each on the minimisers of those above (eq. 9): what XLA makes of a hierarchy."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._damping import effective, room_below
from .._dense import apply, product
from .._lanes import choose
from .._level import Level
from ._held import independent
from ._landing import Landing, land, noise, nothing_landed
from ._primal import LevelState, solve_level
from ._problem import Tolerances, WorkingSet
from ._proposal import propose
from ._replay import Decision
from ._stack import Layout, Stack, Task

NOTHING = 1e-2
"""Share of the rank tolerance up to which a pivot is none, whatever the rank that another factorisation found."""

_LOST = 100.0
"""Rank tolerances; a level whose optimum those below it have worsened by more was not kept."""


class _Cascade(NamedTuple):
    """What the levels so far have fixed."""

    x: Float[Array, " n"]
    lower: Float[Array, " h"]  # of the hard rows: those of levels done are widened to the values reached
    upper: Float[Array, " h"]
    frozen: Bool[Array, " h"]
    side: Int[Array, " h"]  # held and not frozen
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    bent: Float[Array, " n"]  # how much each variable bends the rows of the levels so far
    box: Int[Array, " n"]  # active bounds, frozen or held
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]


class Descent(NamedTuple):
    """Where the last level ended, and what each level decided."""

    x: Float[Array, " n"]
    box: Int[Array, " n"]  # active bounds
    decisions: Decision  # with a leading axis, the levels, and so the following
    working: WorkingSet
    multipliers: Float[Array, "L h"]
    reached: Float[Array, " L"]  # the norm of each level's slack at its own optimum
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]


def descent_of(
    x: Array,
    multipliers: Array,
    reached: Array,
    strengths: Array,
    residual: Array,
    box: Array,
    sides: Array,
    tight: Array,
    missed: Array,
    own: Array,
    ranks: Array,
    report: Array,
) -> Descent:
    """What a kernel gives for a batch; ``report`` has whether it came to an end, iterations and factorisations."""
    return Descent(
        x=x,
        box=box,
        decisions=Decision(jnp.where(strengths[:, :, None] > 0.0, sides, tight), tight, missed, ranks),
        working=WorkingSet(sides, own),
        multipliers=multipliers,
        reached=reached,
        residual=residual,
        iterations=report[:, 1],
        factorizations=report[:, 2],
        done=report[:, 0] != 0,
    )


def descend_all(layout: Layout, cap: int, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None) -> Descent:
    """All levels, all lanes: every array has a leading axis, the lanes, and then perhaps one of levels.

    Args:
        layout: where rows stand (static).
        cap: on the active-set iterations of one level (static).
        stack: the numbers.
        tolerances: what counts as zero.
        warm: working sets to try first; all zeros in a lane for none.
    """

    def descend(cascade: _Cascade, now: tuple[Array, Any, WorkingSet | None]) -> tuple[_Cascade, _Outcome]:
        k, level, guess = now
        task = jax.vmap(partial(_task, layout, k))(stack, level, cascade)
        free = jnp.trace(cascade.projector, axis1=1, axis2=2) > 0.5
        as_it_is = _skip(cascade, task)

        def solve() -> tuple[_Cascade, _Outcome]:
            new = _descend(cascade, task, free, tolerances=tolerances, guess=guess, known=known, cap=cap)
            return choose(free, new, as_it_is)

        return jax.lax.cond(jnp.any(free), solve, lambda: as_it_is)

    first = jax.vmap(_start)(stack)
    known = None if warm is None else jnp.any(warm.own != 0, (1, 2))  # that of a solution has at least the last level's
    levels, guesses = (jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), tree) for tree in (stack.levels, warm))
    numbers = jnp.arange(layout.levels)
    cascade, outcomes = jax.lax.scan(descend, first, (numbers, levels, guesses))
    decisions, working, multipliers, reached = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), outcomes)
    n = layout.variables
    narrowed = jnp.where(
        cascade.box < 0, cascade.lower[:, :n] > stack.hard_lower[:, :n], cascade.upper[:, :n] < stack.hard_upper[:, :n]
    )
    end = Descent(
        x=cascade.x,
        box=jnp.where(narrowed, 0, cascade.box),
        decisions=decisions,
        working=working,
        multipliers=multipliers,
        reached=reached,
        residual=cascade.residual,
        iterations=cascade.iterations,
        factorizations=cascade.factorizations,
        done=cascade.done,
    )
    return jax.vmap(certified)(end, stack, tolerances)


def _start(stack: Stack) -> _Cascade:
    h, n = stack.hard.shape
    dtype = stack.hard.dtype
    lower, upper = stack.hard_lower[:n], stack.hard_upper[:n]
    pinned = stack.hard_equal[:n]
    nothing = jnp.asarray(0, jnp.int32)
    return _Cascade(
        x=jnp.clip(jnp.zeros(n, dtype), lower, upper),
        lower=stack.hard_lower,
        upper=stack.hard_upper,
        frozen=jnp.pad(pinned, (0, h - n)),
        side=jnp.zeros(h, jnp.int32),
        projector=jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(dtype)),
        bent=jnp.zeros(n, dtype),
        box=jnp.where(pinned, 2, 0).astype(jnp.int32),
        residual=jnp.zeros((), dtype),
        iterations=nothing,
        factorizations=nothing,
        done=jnp.asarray(True),
    )


_Outcome = tuple[Decision, WorkingSet, Float[Array, "*B h"], Float[Array, "*B"]]


def _task(layout: Layout, k: Int[Array, ""], stack: Stack, level: Level, cascade: _Cascade) -> Task:
    """Level k, and the rows that it must not touch."""
    of = jnp.asarray(layout.level_of_hard)
    bounded = jnp.isfinite(cascade.lower) | jnp.isfinite(cascade.upper)
    n = len(cascade.x)
    own = jax.tree.map(lambda a: a[k], stack.damping)
    return Task(
        level=level,
        damping=effective(own, level, cascade.x, cascade.projector, cascade.lower[:n], cascade.upper[:n]),
        given=own,
        equal=stack.equal[k],
        matrix=stack.hard,
        lower=cascade.lower,
        upper=cascade.upper,
        free=~cascade.frozen & bounded & (of < k),
        own=of == k,
        soft=(of == k) & ~stack.hard_equal,
        place=jnp.asarray(layout.place_of_row)[k],
        projector=cascade.projector,
        x=cascade.x,
    )


def _descend(
    cascade: _Cascade,
    task: Task,
    wanted: Bool[Array, " B"],
    *,
    tolerances: Tolerances,
    guess: WorkingSet | None,
    known: Bool[Array, " B"] | None,
    cap: int,
) -> tuple[_Cascade, _Outcome]:
    """Solves one more level in the lanes that want it, and freezes what it decides."""
    best, changes, factorizations = _land(task, wanted, tolerances, guess, known, cap)

    def by_hand() -> tuple[LevelState, Array]:
        start = jax.vmap(_by_hand_from)(task, cascade.side, best, tolerances)
        end = jax.vmap(partial(solve_level, max_iterations=cap))(task, start, tolerances)
        return end, end.iterations

    end, more = jax.lax.cond(jnp.all(best.optimal), lambda: (jax.vmap(_at)(best), jnp.zeros_like(changes)), by_hand)
    counted = cascade._replace(
        iterations=cascade.iterations + changes + more,
        factorizations=cascade.factorizations + factorizations + 2 * more + 1,
    )
    return jax.vmap(_freeze)(counted, task, end, tolerances)


class _Attempts(NamedTuple):
    """The working set of the warm start, then the one that the dual method proposes."""

    count: Int[Array, ""]
    best: Landing
    changes: Int[Array, " B"]
    factorizations: Int[Array, " B"]


def _land(
    task: Task,
    wanted: Bool[Array, " B"],
    tolerances: Tolerances,
    guess: WorkingSet | None,
    known: Bool[Array, " B"] | None,
    cap: int,
) -> tuple[Landing, Int[Array, " B"], Int[Array, " B"]]:
    """Lands where the warm start says and, in the lanes where that is not the optimum, where the dual method says."""

    def named() -> tuple[Array, WorkingSet, Array]:
        assert guess is not None
        return task.x, jax.vmap(_usable)(task, guess), none

    def go_on(s: _Attempts) -> Bool[Array, ""]:
        return (s.count < 2) & ~jnp.all(s.best.optimal)

    def attempt(s: _Attempts) -> _Attempts:
        def proposed() -> tuple[Array, WorkingSet, Array]:
            return propose(task, ~s.best.optimal, cap)

        x, working, changes = proposed() if guess is None else jax.lax.cond(s.count == 0, named, proposed)
        landed = jax.vmap(land)(task, x, working, tolerances)
        skipped = s.best.optimal if known is None else s.best.optimal | ((s.count == 0) & ~known)
        spent = jnp.where(skipped, 0, 2 + s.count)  # a proposal has factored the damped level
        best = choose(skipped, s.best, landed)
        return _Attempts(s.count + 1, best, s.changes + changes, s.factorizations + spent)

    none = jnp.zeros(len(wanted), jnp.int32)
    nowhere = jax.vmap(nothing_landed)(task)._replace(optimal=~wanted)
    first = jnp.asarray(1 if guess is None else 0, jnp.int32)
    return jax.lax.while_loop(go_on, attempt, _Attempts(first, nowhere, none, none))[1:]


def _usable(task: Task, warm: WorkingSet) -> WorkingSet:
    """The warm start as far as its bounds exist."""
    level = task.level
    named = jnp.sign(warm.own)
    named = jnp.where(jnp.isfinite(jnp.where(named < 0, level.lower, level.upper)), named, 0)
    own = jnp.where(task.equal, 2, named)
    side = jnp.sign(warm.hard)
    side = jnp.where(task.free & jnp.isfinite(jnp.where(side < 0, task.lower, task.upper)), side, 0)
    return WorkingSet(side.astype(jnp.int32), own.astype(jnp.int32))


def _at(landing: Landing) -> LevelState:
    """The state of a level that ended where it landed."""
    nothing = jnp.asarray(0, jnp.int32)
    return LevelState(*landing[:-2], nothing, nothing, landing.optimal)


def _by_hand_from(task: Task, side: Int[Array, " h"], landing: Landing, tolerances: Tolerances) -> LevelState:
    """Where the landing is feasible, from there; else from where the level above ended."""
    before = _at(nothing_landed(task))._replace(side=independent(task, side, tolerances.rank))
    return jax.tree.map(lambda a, b: jnp.where(landing.feasible, a, b), _at(landing), before)


def _freeze(cascade: _Cascade, task: Task, end: LevelState, tolerances: Tolerances) -> tuple[_Cascade, _Outcome]:
    n, level = len(task.x), task.level
    value = apply(level.matrix, end.x)
    slack = value - jnp.clip(value, level.lower, level.upper)
    missing = task.missing(end.x, slack)
    counts = task.equal | (jnp.abs(slack) > tolerances.multiplier * (level.length * jnp.max(jnp.abs(end.x)) + missing))
    gradient = task.gradient(end.x, jnp.where(counts, slack, 0.0))
    pressure = jnp.abs(end.multiplier) * task.length
    floor = tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) + noise(task, end.x, slack, tolerances)
    # a force that the damping explains leaves the levels below room on the face that the level has reached
    tight = (end.side != 0) & (pressure > floor + task.damping * jnp.sqrt(jnp.sum(end.x**2)))
    rows = jnp.argsort(~tight, stable=True)[:n]
    length = jnp.where(tight, task.length, 1.0)[rows]
    to_freeze = jnp.concatenate(
        [
            jnp.where(tight[rows], 1.0 / length, 0.0)[:, None] * task.matrix[rows],
            jnp.where(counts[:, None], level.matrix, 0.0) / jnp.where(level.size > 0.0, level.size, 1.0),
        ]
    )
    bounds = jnp.sum(tight, dtype=jnp.int32)
    same = jnp.all(counts == end.counts)
    decided = jnp.where(same & jnp.all(tight == (end.side != 0)), bounds + end.rank, -1)
    basis, rank = _row_space(to_freeze, task.projector, decided, tolerances.rank)
    missed = jnp.where(counts, jnp.where(slack > 0.0, 1, -1), 0).astype(jnp.int32)
    reached = apply(task.matrix, end.x)
    low, high, bent = room_below(task.given, level, cascade.bent, end.x, task.lower[:n], task.upper[:n])
    after = cascade._replace(
        x=end.x,
        lower=jnp.where(task.own, jnp.minimum(task.lower, reached), task.lower).at[:n].set(low),
        upper=jnp.where(task.own, jnp.maximum(task.upper, reached), task.upper).at[:n].set(high),
        frozen=cascade.frozen | tight | task.spread(counts),
        side=jnp.where(tight, 0, end.side),
        projector=task.projector - product(basis, basis.T),
        bent=bent,
        box=jnp.where(end.side[:n] != 0, end.side[:n], jnp.where(cascade.frozen[:n], cascade.box, 0)),
        residual=jnp.maximum(cascade.residual, end.residual),
        done=cascade.done & end.done,
    )
    own = jnp.where(task.equal, 2, missed).astype(jnp.int32)
    # rows held without a multiplier decide nothing, unless more of the level would count without them (a tie)
    tie = same & (rank - bounds != end.rank) & (task.damping == 0.0)
    kept = jnp.where(tight | tie, end.side, 0)
    rank = jnp.where(tie, end.rank, rank - bounds)
    decision = Decision(jnp.where(task.damping > 0.0, end.side, kept), kept, missed, rank)
    return after, (decision, WorkingSet(end.side, own), end.multiplier, jnp.sqrt(jnp.sum(slack**2)))


def _skip(cascade: _Cascade, task: Task) -> tuple[_Cascade, _Outcome]:
    """A level that finds no freedom decides nothing."""
    none, own = jnp.zeros_like(cascade.side), jnp.zeros(task.level.lower.shape, jnp.int32)
    decision = Decision(none, none, own, jnp.zeros_like(cascade.iterations))
    anything = jnp.full_like(cascade.residual, jnp.inf)  # x has stopped moving
    return cascade, (decision, WorkingSet(none, own), jnp.zeros_like(cascade.lower), anything)


def certified(end: Descent, stack: Stack, tolerances: Tolerances) -> Descent:
    """With what the levels below took from each level's optimum: part of the residual, and of the verdict.

    Rounding is that of the largest x on the way: levels may have been at bounds that those below them have left.
    """
    length = jnp.sqrt(jnp.sum(stack.hard**2, -1))
    bound = jnp.where(end.working.hard < 0, stack.hard_lower, stack.hard_upper)
    held = (end.working.hard != 0) & (length > 0.0) & jnp.isfinite(bound)  # a narrowed bound is nearer than x
    been = jnp.max(jnp.where(held, jnp.abs(bound) / jnp.where(length > 0.0, length, 1.0), 0.0))
    reach = jnp.maximum(jnp.max(jnp.abs(end.x)), been)

    def lost(level: Level, reached: Array) -> tuple[Array, Array]:
        slack = jnp.sqrt(jnp.sum(level.distance(end.x) ** 2))
        more = jnp.maximum(slack - reached, 0.0)
        allowed = _LOST * tolerances.rank * (level.size * reach + slack)
        return level.size * more, more <= allowed

    residual, kept = jax.vmap(lost)(stack.levels, end.reached)
    return end._replace(residual=jnp.maximum(end.residual, jnp.max(residual)), done=end.done & jnp.all(kept))


def _row_space(
    rows: Float[Array, "m n"], projector: Float[Array, "n n"], decided: Int[Array, ""], rank: Array | float
) -> tuple[Float[Array, "n k"], Int[Array, ""]]:
    """Orthonormal basis (0 columns beyond the rank) of what the rows span inside the projector's range, and its size.

    The rank is what is decided; where that is negative, the number of pivots above the tolerance.
    """
    basis, triangle, _ = jax.scipy.linalg.qr(product(rows, projector).T, mode="economic", pivoting=True)
    pivots = jnp.abs(jnp.diagonal(triangle))
    known = (jnp.arange(len(pivots)) < decided) & (pivots > NOTHING * rank)
    keep = jnp.where(decided < 0, pivots > rank, known)
    basis = product(projector, jnp.where(keep, basis, 0.0))
    for _ in range(2):  # a column from a small pivot left the range by rounding over that pivot: back, and orthonormal
        basis = 1.5 * basis - 0.5 * product(basis, product(basis.T, basis))
    return basis, jnp.sum(keep, dtype=jnp.int32)
