"""Search for hierarchies in plain JAX: level after level, each over the minimisers of the levels above (eq. 9).

Each level is solved by the primal active-set method (``_primal_active_set.py``), then exactly on the working set that
was found (``_working_set_solve.py``), and freezes what it determines (``_freeze.py``). There is no warm start: kernels
have one.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._lanes import choose
from ...numerics._constants import MAX_RESIDUAL
from .._damping import HardRows, level_damping
from .._level import PaddedLevel
from ._active_rows import drop_dependent, factor_active_rows
from ._freeze import CascadeState, LevelOutcome, freeze, skip
from ._implicit_diff import ActiveSets
from ._primal_active_set import PrimalState, primal_active_set
from ._problem import Layout, LevelProblem, PaddedHierarchy, Tolerances, WorkingSet
from ._working_set_solve import WorkingSetSolution, solve_on_working_set


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
    layout: Layout, max_iterations: int, hierarchy: PaddedHierarchy, tolerances: Tolerances
) -> CascadeResult:
    """Solve all levels of a batch of hierarchies; arrays have a leading axis of problems, then of levels if any.

    ``max_iterations`` limits the active-set iterations of one level.
    """

    def solve_next(state: CascadeState, now: tuple[Array, PaddedLevel]) -> tuple[CascadeState, LevelOutcome]:
        k, level = now
        problem = jax.vmap(partial(_level_problem, layout, k))(hierarchy, level, state)
        # the trace is the dimension that is left
        is_free = jnp.trace(state.projector, axis1=1, axis2=2) > 0.5
        skipped = skip(state, problem)

        def solve() -> tuple[CascadeState, LevelOutcome]:
            return choose(is_free, _solve_level(state, problem, is_free, tolerances, max_iterations), skipped)

        return jax.lax.cond(jnp.any(is_free), solve, lambda: skipped)

    levels = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), hierarchy.levels)
    state, outcomes = jax.lax.scan(solve_next, jax.vmap(_start)(hierarchy), (jnp.arange(layout.levels), levels))
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
        iterations=zero,
        factorizations=zero,
        done=jnp.asarray(True),
    )


def _level_problem(
    layout: Layout, k: Int[Array, ""], hierarchy: PaddedHierarchy, level: PaddedLevel, state: CascadeState
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
        hard=hierarchy.hard,
        lower=state.lower,
        upper=state.upper,
        may_block=may_block,
        is_own=level_of_hard == k,
        hard_of_row=jnp.asarray(layout.hard_of_row, int)[k],
        projector=state.projector,
        x=state.x,
    )


def _solve_level(
    state: CascadeState, problem: LevelProblem, wanted: Bool[Array, " B"], tolerances: Tolerances, max_iterations: int
) -> tuple[CascadeState, LevelOutcome]:
    """Solve one level by the primal method, and freeze the rows that it determines."""
    start = jax.vmap(_primal_start)(problem, state.active, ~wanted, tolerances)
    end = jax.vmap(partial(primal_active_set, max_iterations=max_iterations))(problem, start, tolerances)
    exact = jax.vmap(solve_on_working_set)(problem, end.x, jax.vmap(_working_set)(problem, end), tolerances)
    exact_end = jax.vmap(_as_primal_state)(exact)._replace(iterations=end.iterations)
    end = choose(exact.optimal & wanted, exact_end, end)
    # an iteration of the primal method factors active rows and least squares, and freezing factors once
    counted = state._replace(
        iterations=state.iterations + end.iterations,
        factorizations=state.factorizations + 2 * end.iterations + 1,
    )
    return jax.vmap(freeze)(counted, problem, end, tolerances)


def _as_primal_state(solution: WorkingSetSolution) -> PrimalState:
    """Return a solution on a working set as the final state of the primal method."""
    zero = jnp.asarray(0, jnp.int32)
    return PrimalState(*solution[:-2], zero, jnp.asarray(False), zero, solution.optimal)


def _working_set(problem: LevelProblem, end: PrimalState) -> WorkingSet:
    """Return the working set at the end of the primal method."""
    side = jnp.where(problem.level.distance(end.x) > 0.0, 1, -1)
    own = jnp.where(problem.level.equal, 2, jnp.where(end.in_cost, side, 0))
    return WorkingSet(end.active, own.astype(jnp.int32))


def _primal_start(
    problem: LevelProblem, active: Int[Array, " h"], done: Bool[Array, ""], tolerances: Tolerances
) -> PrimalState:
    """Return the end of the level above, which is feasible; what it had active may depend on rows frozen since."""
    independent = drop_dependent(active, factor_active_rows(problem, active, tolerances.rank))
    zero, no_cost = jnp.asarray(0, jnp.int32), jnp.zeros(problem.level.lower.shape, bool)
    zeros = jnp.zeros_like(problem.lower)
    return PrimalState(
        problem.x, independent, zeros, no_cost, zero, jnp.zeros_like(problem.x[0]), zero, zero > 0, zero, done
    )


def certify_levels(result: CascadeResult, hierarchy: PaddedHierarchy, tolerances: Tolerances) -> CascadeResult:
    """Check each level's residual, and the change of its reached norm by the levels below.

    The norm of a level at its optimum is one number on all of its minimisers. So a smaller norm at the answer says,
    like a larger one, that one of the two points is no optimum.
    """

    def change(level: PaddedLevel, slack_norm: Array) -> Array:
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
