"""Search for hierarchies in plain JAX: level after level, each over the minimisers of the levels above (eq. 9).

Each level solves on the working set of the warm start (``_working_set_solve.py``), goes on by the primal active-set
method where that is not the optimum (``_primal_active_set.py``), and freezes what it determines (``_freeze.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._lanes import choose
from ...numerics._constants import MAX_DETOUR, MAX_RESIDUAL
from .._damping import HardRows, level_damping
from .._level import Level
from ._active_rows import drop_dependent, factor_active_rows
from ._freeze import CascadeState, LevelOutcome, freeze, skip
from ._implicit_diff import ActiveSets
from ._padding import Layout, LevelProblem, PaddedHierarchy
from ._primal_active_set import PrimalState, primal_active_set
from ._problem import Tolerances, WorkingSet
from ._working_set_solve import WorkingSetSolution, placeholder, solve_on_working_set


class CascadeResult(NamedTuple):
    """Answer of a hierarchy by the search or by a kernel, with the results of each level."""

    x: Float[Array, " n"]
    active_bounds: Int[Array, " n"]
    active_sets: ActiveSets  # with a leading axis of levels, and so the following
    working_sets: WorkingSet
    multipliers: Float[Array, "L h"]
    slack_norms: Float[Array, " L"]  # of each level at its own optimum
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    done: Bool[Array, ""]


def solve_cascade(
    layout: Layout,
    max_iterations: int,
    hierarchy: PaddedHierarchy,
    tolerances: Tolerances,
    warm_start: WorkingSet | None,
) -> CascadeResult:
    """Solve all levels of a batch of hierarchies; arrays have a leading axis of problems, then of levels if any.

    ``max_iterations`` limits the active-set iterations of one level. A warm start of zeros in a problem is none.
    """
    everywhere = jnp.ones(hierarchy.hard.shape[0], bool)
    # all zeros stand for no warm start: an equality of a solution has a 2
    known = ~everywhere if warm_start is None else jnp.any(warm_start.own != 0, (1, 2))
    levels, guesses = (jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), tree) for tree in (hierarchy.levels, warm_start))
    first = jax.vmap(_start)(hierarchy)

    def solve_levels(wanted: Bool[Array, " B"], known: Bool[Array, " B"]) -> tuple[CascadeState, LevelOutcome]:
        def solve_next(
            state: CascadeState, now: tuple[Array, Any, WorkingSet | None]
        ) -> tuple[CascadeState, LevelOutcome]:
            k, level, guess = now
            problem = jax.vmap(partial(_level_problem, layout, k))(hierarchy, level, state)
            # the trace is the dimension that is left
            is_free = wanted & (jnp.trace(state.projector, axis1=1, axis2=2) > 0.5)
            skipped = skip(state, problem)

            def solve() -> tuple[CascadeState, LevelOutcome]:
                usable = is_free & known
                first = _solve_on_warm_start(problem, usable, tolerances, guess)
                counted = state._replace(factorizations=state.factorizations + 2 * usable)  # of active rows and cost
                solved = _solve_level(counted, problem, is_free, first, tolerances, max_iterations)
                return choose(is_free, solved, skipped)

            return jax.lax.cond(jnp.any(is_free), solve, lambda: skipped)

        return jax.lax.scan(solve_next, first, (jnp.arange(layout.levels), levels, guesses))

    if warm_start is None:
        state, outcomes = solve_levels(everywhere, known)
    else:
        state, outcomes = _solve_again_without_guesses(solve_levels, everywhere, known)
    active_sets, working_sets, multipliers, slack_norms = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), outcomes)
    result = CascadeResult(
        x=state.x,
        active_bounds=_bounds_of_the_box(hierarchy, state),
        active_sets=active_sets,
        working_sets=working_sets,
        multipliers=multipliers,
        slack_norms=slack_norms,
        residual=state.residual,
        iterations=state.iterations,
        factorizations=state.factorizations,
        done=state.done,
    )
    return jax.vmap(certify_levels)(result, hierarchy, tolerances)


class _Passes(NamedTuple):
    """Results of two passes through all levels: with the warm start's guesses, and without."""

    count: Int[Array, ""]
    wanted: Bool[Array, " B"]
    state: CascadeState
    outcomes: LevelOutcome


def _solve_again_without_guesses(
    solve_levels: Callable[..., tuple[CascadeState, LevelOutcome]],
    everywhere: Bool[Array, " B"],
    known: Bool[Array, " B"],
) -> tuple[CascadeState, LevelOutcome]:
    """Solve all levels; repeat without the warm start if it failed or led far beyond the answer.

    Tolerances and roundoff of a level are relative to the largest x on its way. So a guess with variables at 1e10
    leaves 1e-6 of roundoff in rows that should hold exactly. ``solve_levels`` takes the problems to solve (all of them
    ``everywhere``) and those with a usable warm start (``known``).
    """

    def is_running(p: _Passes) -> Bool[Array, ""]:
        return (p.count < 2) & jnp.any(p.wanted)

    def solve(p: _Passes) -> _Passes:
        state, outcomes = solve_levels(p.wanted, known & (p.count == 0))
        counted = state._replace(
            iterations=p.state.iterations + state.iterations,
            factorizations=p.state.factorizations + state.factorizations,
        )
        state = choose(p.wanted, counted, p.state)
        outcomes = jax.tree.map(
            lambda new, old: jnp.where(p.wanted.reshape(1, -1, *[1] * (new.ndim - 2)), new, old), outcomes, p.outcomes
        )
        near = state.largest <= MAX_DETOUR * jnp.max(jnp.abs(state.x), 1)
        return _Passes(p.count + 1, known & ~(state.done & near), state, outcomes)

    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(solve_levels, everywhere, known))
    return jax.lax.while_loop(is_running, solve, _Passes(jnp.asarray(0, jnp.int32), everywhere, *nothing))[2:]


def _bounds_of_the_box(hierarchy: PaddedHierarchy, state: CascadeState) -> Int[Array, "B n"]:
    """Return which bounds of the box are active, without bounds that a level narrowed for lower ones."""
    n = state.x.shape[1]
    narrowed = jnp.where(
        state.active_bounds < 0,
        state.lower[:, :n] > hierarchy.hard_lower[:, :n],
        state.upper[:, :n] < hierarchy.hard_upper[:, :n],
    )
    return jnp.where(narrowed, 0, state.active_bounds)


def _start(hierarchy: PaddedHierarchy) -> CascadeState:
    """Return the point of the box nearest to 0, with variables of equal bounds frozen."""
    h, n = hierarchy.hard.shape
    dtype = hierarchy.hard.dtype
    lower, upper = hierarchy.hard_lower[:n], hierarchy.hard_upper[:n]
    pinned = hierarchy.hard_is_equality[:n]
    zero = jnp.asarray(0, jnp.int32)
    return CascadeState(
        x=jnp.clip(jnp.zeros(n, dtype), lower, upper),
        lower=hierarchy.hard_lower,
        upper=hierarchy.hard_upper,
        frozen=jnp.pad(pinned, (0, h - n)),
        active=jnp.zeros(h, jnp.int32),
        projector=jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(dtype)),
        curvature=jnp.zeros(n, dtype),
        active_bounds=jnp.where(pinned, 2, 0).astype(jnp.int32),
        residual=jnp.zeros((), dtype),
        largest=jnp.zeros((), dtype),
        iterations=zero,
        factorizations=zero,
        done=jnp.asarray(True),
    )


def _level_problem(
    layout: Layout, k: Int[Array, ""], hierarchy: PaddedHierarchy, level: Level, state: CascadeState
) -> LevelProblem:
    """Return level k with the hard rows and the frozen rows that it must keep."""
    level_of_hard = jnp.asarray(layout.level_of_hard)
    bounded = jnp.isfinite(state.lower) | jnp.isfinite(state.upper)
    n = len(state.x)
    terms = jax.tree.map(lambda a: a[k], hierarchy.damping)
    may_block = ~state.frozen & bounded & (level_of_hard < k)
    above = HardRows(
        hierarchy.hard[n:],
        jnp.where(may_block, state.lower, -jnp.inf)[n:],
        jnp.where(may_block, state.upper, jnp.inf)[n:],
    )
    return LevelProblem(
        level=level,
        damping=level_damping(terms, level, state.x, state.projector, state.lower[:n], state.upper[:n], above),
        damping_terms=terms,
        is_equality=hierarchy.is_equality[k],
        hard=hierarchy.hard,
        lower=state.lower,
        upper=state.upper,
        may_block=may_block,
        is_own=level_of_hard == k,
        is_own_inequality=(level_of_hard == k) & ~hierarchy.hard_is_equality,
        hard_of_row=jnp.asarray(layout.hard_of_row, int)[k],
        projector=state.projector,
        x=state.x,
    )


def _solve_level(
    state: CascadeState,
    problem: LevelProblem,
    wanted: Bool[Array, " B"],
    first: WorkingSetSolution,
    tolerances: Tolerances,
    max_iterations: int,
) -> tuple[CascadeState, LevelOutcome]:
    """Solve one level by the primal method where ``first`` is not optimal, and freeze the rows that it determines."""
    done = first.optimal | ~wanted

    def search() -> PrimalState:
        start = jax.vmap(_primal_start)(problem, state.active, first, tolerances)._replace(done=done)
        end = jax.vmap(partial(primal_active_set, max_iterations=max_iterations))(problem, start, tolerances)
        exact = jax.vmap(solve_on_working_set)(problem, end.x, jax.vmap(_working_set)(problem, end), tolerances)
        exact_end = jax.vmap(_as_primal_state)(exact)._replace(iterations=end.iterations)
        return choose(exact.optimal & ~done, exact_end, end)

    end = jax.lax.cond(jnp.all(done), lambda: jax.vmap(_as_primal_state)(first), search)
    # an iteration of the primal method factors active rows and least squares, and freezing factors once
    counted = state._replace(
        largest=jnp.maximum(state.largest, jnp.where(first.feasible, jnp.max(jnp.abs(first.x), 1), 0.0)),
        iterations=state.iterations + end.iterations,
        factorizations=state.factorizations + 2 * end.iterations + 1,
    )
    return jax.vmap(freeze)(counted, problem, end, tolerances)


def _solve_on_warm_start(
    problem: LevelProblem, usable: Bool[Array, " B"], tolerances: Tolerances, guess: WorkingSet | None
) -> WorkingSetSolution:
    """Solve each level on the warm start's working set; problems without a usable one get placeholders."""
    nothing = jax.vmap(placeholder)(problem)
    if guess is None:
        return nothing

    def solve() -> WorkingSetSolution:
        working_set = jax.vmap(_usable_guess)(problem, guess)
        return choose(usable, jax.vmap(solve_on_working_set)(problem, problem.x, working_set, tolerances), nothing)

    return jax.lax.cond(jnp.any(usable), solve, lambda: nothing)


def _usable_guess(problem: LevelProblem, warm_start: WorkingSet) -> WorkingSet:
    """Return the warm start without rows of infinite bounds and rows that cannot block."""
    level = problem.level
    # an inequality may have become an equality since, or the other way round
    own = jnp.sign(warm_start.own)
    own = jnp.where(jnp.isfinite(jnp.where(own < 0, level.lower, level.upper)), own, 0)
    own = jnp.where(problem.is_equality, 2, own)
    active = jnp.sign(warm_start.hard)
    bound = jnp.where(active < 0, problem.lower, problem.upper)
    active = jnp.where(problem.may_block & jnp.isfinite(bound), active, 0)
    return WorkingSet(active.astype(jnp.int32), own.astype(jnp.int32))


def _as_primal_state(solution: WorkingSetSolution) -> PrimalState:
    """Return a solution on a working set as the final state of the primal method."""
    zero = jnp.asarray(0, jnp.int32)
    return PrimalState(*solution[:-2], zero, jnp.asarray(False), zero, solution.optimal)


def _working_set(problem: LevelProblem, end: PrimalState) -> WorkingSet:
    """Return the working set at the end of the primal method."""
    side = jnp.where(problem.level.distance(end.x) > 0.0, 1, -1)
    own = jnp.where(problem.is_equality, 2, jnp.where(end.in_cost, side, 0))
    return WorkingSet(end.active, own.astype(jnp.int32))


def _primal_start(
    problem: LevelProblem, active: Int[Array, " h"], solution: WorkingSetSolution, tolerances: Tolerances
) -> PrimalState:
    """Return the solution on the guessed working set if it is feasible, else the end of the level above."""
    # the end of the level above is feasible; what it had active may depend on rows that were frozen since
    independent = drop_dependent(active, factor_active_rows(problem, active, tolerances.rank))
    above = _as_primal_state(placeholder(problem))._replace(active=independent)
    return jax.tree.map(lambda a, b: jnp.where(solution.feasible, a, b), _as_primal_state(solution), above)


def certify_levels(result: CascadeResult, hierarchy: PaddedHierarchy, tolerances: Tolerances) -> CascadeResult:
    """Check each level's residual, and the change of its reached norm by the levels below.

    The norm of a level at its optimum is one number on all of its minimisers. So a smaller norm at the answer says,
    like a larger one, that one of the two points is no optimum.
    """

    def change(level: Level, slack_norm: Array) -> Array:
        now = jnp.sqrt(jnp.sum(level.distance(result.x) ** 2))
        terms = jnp.maximum(level.size * jnp.max(jnp.abs(result.x)), now)
        # a level that found no freedom left has an infinite norm: nothing below it moves x
        changed = jnp.where(jnp.isfinite(slack_norm), jnp.abs(now - slack_norm), 0.0)
        return changed / jnp.where(terms > 0.0, terms, 1.0)

    changes = jax.vmap(change)(hierarchy.levels, result.slack_norms)
    n = len(result.x)
    # the answer is on its active bounds to the last bit, so x has to be there but for roundoff
    bound = jnp.where(result.active_bounds < 0, hierarchy.hard_lower[:n], hierarchy.hard_upper[:n])
    gap = jnp.where(
        result.active_bounds != 0, jnp.abs(result.x - jnp.where(result.active_bounds != 0, bound, 0.0)), 0.0
    )
    size = jnp.max(jnp.abs(result.x))
    off_bound = jnp.max(gap) / jnp.where(size > 0.0, size, 1.0)
    residual = jnp.maximum(result.residual, jnp.maximum(jnp.max(changes), off_bound))
    return result._replace(residual=residual, done=result.done & (residual <= MAX_RESIDUAL * tolerances.rank))
