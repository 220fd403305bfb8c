"""solve_hqp: level after level, each on the minimisers of those above (eq. 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._box import inside, uncrossed
from .._dense import apply, product
from .._double import in_double
from .._lanes import choose, in_lanes
from .._status import Status
from ._held import independent
from ._landing import Landing, land, noise, nothing_landed
from ._primal import LevelState, solve_level
from ._problem import HQPSolution, Level, Tolerances, WorkingSet
from ._proposal import propose
from ._replay import Decision, with_derivative
from ._stack import Layout, Stack, Task, stacked

_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-6}
"""Rounding of the data makes rows independent that are not."""


_LOST = 100.0
"""Rank tolerances; a level whose optimum those below it have worsened by more was not kept."""

_NOTHING = 1e-2
"""Share of the rank tolerance up to which a pivot is none, whatever the rank that another factorisation found."""


@partial(jax.jit, static_argnames="max_iterations")
def solve_hqp(
    levels: Sequence[Level],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    *,
    warm_start: WorkingSet | None = None,
    max_iterations: int | None = None,
    tolerances: Tolerances | None = None,
) -> HQPSolution:
    """Lexicographic least squares: level k minimises |w_k|^2 among the minimisers of the levels before it.

    w_k is the (weighted) distance of the level's rows A_k x to their intervals [lower_k, upper_k]; the box
    ``lower <= x <= upper`` is hard at every level. What freedom is left after the last level goes into the smallest
    |x|, so that the answer is unique. Pure, compiled on first use, and batched by ``vmap``.

    Each level tries the working set of the warm start, then one that a dual method proposes, and judges the exact
    solution on it by its multipliers; where neither is the optimum, a primal active set goes on by hand. A row
    violated at its optimum, and every hard row with a nonzero multiplier, is tight on the whole face of minimisers: it
    is frozen as an equality before the next level and eliminated by its null space. The search is in double precision
    also where the data are single.

    Args:
        levels: highest priority first; any number, each an equality or inequality level or a mixture.
        lower: box, -inf where unbounded. (n,)
        upper: box, inf where unbounded. (n,)
        warm_start: that of the solution of a problem nearby with the same levels. It changes the time, not the answer.
        max_iterations: cap on the active-set iterations of one level (static); default 10 (n + rows of the level).
        tolerances: what counts as zero; the default rank tolerance depends on the precision of the data.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.

    When not to use it: one level (``solve_least_squares_qp`` is several times faster).
    """
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    dtype = jnp.result_type(lower, *(level.matrix for level in levels))
    tolerances = Tolerances(rank=_RANK[dtype]) if tolerances is None else tolerances
    sane = _finite(levels, lower, upper)
    equal = [level.equal | ~sane for level in levels]
    levels, crossed = zip(*(level.uncrossed() for level in levels), strict=True) if levels else ((), ())
    low, high, empty = uncrossed(lower, upper)
    possible = ~jnp.stack([empty, *crossed]).any()
    low, high = (jnp.where(sane, b, side).astype(dtype) for b, side in ((low, -1.0), (high, 1.0)))
    scaled = [jax.tree.map(lambda leaf: jnp.where(sane, leaf, 0.0), level.scaled()) for level in levels]
    scaled, equal = [*scaled, _smallest(len(low), dtype)], [*equal, jnp.ones(len(low), bool)]
    layout, stack = stacked(scaled, equal, low, high, (lower >= upper) & sane)
    traced = jax.tree.map(lambda a: jnp.asarray(a, dtype), tolerances)
    end = _descender(layout, max_iterations)(*jax.lax.stop_gradient((stack, traced, warm_start)))
    nothing = jnp.maximum(_NOTHING * traced.rank, 100.0 * jnp.finfo(dtype).eps)
    x = with_derivative(end.cascade.x, end.decisions, stack, nothing)
    return _answer(levels, layout, end, x, sane, possible, lower, upper)


def _smallest(n: int, dtype: jnp.dtype) -> Level:
    """The last level: what freedom is left goes into the smallest norm."""
    return Level(jnp.eye(n, dtype=dtype), jnp.zeros(n, dtype))


class _Cascade(NamedTuple):
    """What the levels so far have fixed."""

    x: Float[Array, " n"]
    lower: Float[Array, " h"]  # of the hard rows: those of levels done are widened to the values reached
    upper: Float[Array, " h"]
    frozen: Bool[Array, " h"]
    side: Int[Array, " h"]  # held and not frozen
    projector: Float[Array, "n n"]  # onto the null space of the frozen rows
    box: Int[Array, " n"]  # active bounds, frozen or held
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]


class _End(NamedTuple):
    """The cascade after its last level, and what each level decided."""

    cascade: _Cascade
    decisions: Decision  # with a leading axis, the levels, and so the following
    working: WorkingSet
    multipliers: Float[Array, "L h"]
    reached: Float[Array, " L"]  # the norm of each level's slack at its own optimum


@cache
def _descender(layout: Layout, max_iterations: int | None) -> Callable[..., _End]:
    cap = 10 * (layout.variables + layout.rows) if max_iterations is None else max_iterations
    return in_lanes(in_double(partial(_descend_all, layout, cap)))


def _descend_all(layout: Layout, cap: int, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None) -> _End:
    """All levels, all lanes: every array has a leading axis, the lanes, and then perhaps one of levels."""

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
    end = _End(cascade, *jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), outcomes))
    return end._replace(cascade=jax.vmap(partial(_certified, tolerances=tolerances))(cascade, stack, end.reached))


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
        box=jnp.where(pinned, 2, 0).astype(jnp.int32),
        residual=jnp.zeros((), dtype),
        iterations=nothing,
        factorizations=nothing,
        done=jnp.asarray(True),
    )


_Outcome = tuple[Decision, WorkingSet, Float[Array, "B h"], Float[Array, " B"]]


def _task(layout: Layout, k: Int[Array, ""], stack: Stack, level: Level, cascade: _Cascade) -> Task:
    """Level k, and the rows that it must not touch."""
    of = jnp.asarray(layout.level_of_hard)
    bounded = jnp.isfinite(cascade.lower) | jnp.isfinite(cascade.upper)
    return Task(
        level=level,
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
    small = tolerances.multiplier * (level.length * jnp.max(jnp.abs(end.x)) + jnp.sqrt(jnp.sum(slack**2)))
    counts = task.equal | (jnp.abs(slack) > small)
    gradient = apply(level.matrix.T, jnp.where(counts, slack, 0.0))
    pressure = jnp.abs(end.multiplier) * task.length
    floor = tolerances.multiplier * jnp.sqrt(jnp.sum(gradient**2)) + noise(level, end.x, slack, tolerances)
    tight = (end.side != 0) & (pressure > floor)
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
    after = cascade._replace(
        x=end.x,
        lower=jnp.where(task.own, jnp.minimum(task.lower, reached), task.lower),
        upper=jnp.where(task.own, jnp.maximum(task.upper, reached), task.upper),
        frozen=cascade.frozen | tight | task.spread(counts),
        side=jnp.where(tight, 0, end.side),
        projector=task.projector - product(basis, basis.T),
        box=jnp.where(end.side[:n] != 0, end.side[:n], jnp.where(cascade.frozen[:n], cascade.box, 0)),
        residual=jnp.maximum(cascade.residual, end.residual),
        done=cascade.done & end.done,
    )
    own = jnp.where(task.equal, 2, missed).astype(jnp.int32)
    # rows held without a multiplier decide nothing, unless more of the level would count without them (a tie)
    tie = same & (rank - bounds != end.rank)
    decision = Decision(jnp.where(tight | tie, end.side, 0), missed, jnp.where(tie, end.rank, rank - bounds))
    return after, (decision, WorkingSet(end.side, own), end.multiplier, jnp.sqrt(jnp.sum(slack**2)))


def _skip(cascade: _Cascade, task: Task) -> tuple[_Cascade, _Outcome]:
    """A level that finds no freedom decides nothing."""
    none, own = jnp.zeros_like(cascade.side), jnp.zeros(task.level.lower.shape, jnp.int32)
    decision = Decision(none, own, jnp.zeros_like(cascade.iterations))
    anything = jnp.full_like(cascade.residual, jnp.inf)  # x has stopped moving
    return cascade, (decision, WorkingSet(none, own), jnp.zeros_like(cascade.lower), anything)


def _certified(cascade: _Cascade, stack: Stack, reached: Float[Array, " L"], *, tolerances: Tolerances) -> _Cascade:
    """What the levels below took from each level's optimum: part of the residual, and the verdict."""

    def lost(level: Level, reached: Array) -> tuple[Array, Array]:
        slack = jnp.sqrt(jnp.sum(level.distance(cascade.x) ** 2))
        more = jnp.maximum(slack - reached, 0.0)
        allowed = _LOST * tolerances.rank * (level.size * jnp.max(jnp.abs(cascade.x)) + slack)
        return level.size * more, more <= allowed

    residual, kept = jax.vmap(lost)(stack.levels, reached)
    return cascade._replace(
        residual=jnp.maximum(cascade.residual, jnp.max(residual)), done=cascade.done & jnp.all(kept)
    )


def _row_space(
    rows: Float[Array, "m n"], projector: Float[Array, "n n"], decided: Int[Array, ""], rank: Array | float
) -> tuple[Float[Array, "n k"], Int[Array, ""]]:
    """Orthonormal basis (0 columns beyond the rank) of what the rows span inside the projector's range, and its size.

    The rank is what is decided; where that is negative, the number of pivots above the tolerance.
    """
    basis, triangle, _ = jax.scipy.linalg.qr(product(rows, projector).T, mode="economic", pivoting=True)
    pivots = jnp.abs(jnp.diagonal(triangle))
    known = (jnp.arange(len(pivots)) < decided) & (pivots > _NOTHING * rank)
    keep = jnp.where(decided < 0, pivots > rank, known)
    basis = product(projector, jnp.where(keep, basis, 0.0))
    for _ in range(2):  # a column from a small pivot left the range by rounding over that pivot: back, and orthonormal
        basis = 1.5 * basis - 0.5 * product(basis, product(basis.T, basis))
    return basis, jnp.sum(keep, dtype=jnp.int32)


def _finite(levels: Sequence[Level], lower: Array, upper: Array) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN, no infinity but as no bound."""
    checks = [jnp.isfinite(level.matrix).all() for level in levels]
    checks += [(low < jnp.inf).all() & (high > -jnp.inf).all() for low, high in _bounds(levels, lower, upper)]
    checks += [jnp.isfinite(level.weight).all() for level in levels if level.weight is not None]
    return jnp.stack(checks).all()


def _bounds(levels: Sequence[Level], lower: Array, upper: Array) -> list[tuple[Array, Array]]:
    return [(lower, upper), *((level.lower, level.upper) for level in levels)]


def _answer(
    levels: Sequence[Level],
    layout: Layout,
    end: _End,
    x: Array,
    sane: Array,
    possible: Array,
    lower: Array,
    upper: Array,
) -> HQPSolution:
    cascade = end.cascade
    at_bound = jnp.where(cascade.box < 0, lower, jnp.where(cascade.box > 0, upper, x))
    good = sane & jnp.isfinite(x).all()
    x = inside(jnp.where(good, at_bound, 0.0), lower, upper)
    status = jnp.where(cascade.done, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(possible, status, Status.INFEASIBLE)
    return HQPSolution(
        x=x,
        slacks=tuple(jnp.where(good, level.distance(x), 0.0) for level in levels),
        status=jnp.where(good, status, Status.NUMERICAL_ERROR),
        iterations=cascade.iterations,
        factorizations=cascade.factorizations,
        kkt_residual=jnp.where(good, cascade.residual, jnp.inf),
        active=cascade.box,
        active_rows=tuple(end.working.own[k, : len(level.lower)] for k, level in enumerate(levels)),
        multipliers=jnp.where(good, end.multipliers[:-1], 0.0),
        warm_start=end.working,
    )
