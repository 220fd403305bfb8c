"""Active set of a strictly convex QP by the dual active-set method of Goldfarb and Idnani on a tableau.

The iterate is the minimiser for some active set whose multipliers have the right signs (wrong ones are dropped first).
The method takes the violated constraint whose activation raises the dual objective most, and moves along the dual until
that constraint holds or the multiplier of an active one reaches zero. The dual objective never falls, so no active set
returns and there is no cycling (D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex
quadratic programs", Mathematical Programming 27, 1983, referred to as GI).

The paper updates orthogonal factors; here the state is one matrix over the m constraints. Inactive constraints have a
value s and no multiplier, active ones a multiplier y and a prescribed value. The unknown s and y are an affine function
of the prescribed ones, and its matrix is the tableau T. Making constraint k active or inactive exchanges s_k and y_k:
one principal pivot, a rank-1 update, whatever the active set. Shapes are static, and nothing is factored again
(docs/dev/derivations.md, "The dual active-set step").

An iteration decides on a step and leaves it in the carry for the next one to apply. XLA's CPU compiler would otherwise
inline the decision into every element of the tableau's update; so it finds two vectors there.

When not to use it: thousands of rows (the tableau is dense).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..execution._double import first_smallest
from ..numerics._constants import AT_LOWER, AT_UPPER, DEPENDENCE_TOL, EQUALITY, INACTIVE, REDUNDANCY_TOL


class Roundoff(NamedTuple):
    """Tolerances below which a violation, or a multiplier of the wrong sign, is roundoff."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


class Constraints(NamedTuple):
    """Constraints in the units of the tableau: each is scaled to a diagonal element of 1."""

    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    equality: Bool[Array, " m"]
    roundoff: Roundoff
    scale: Float[Array, " m"]  # the initial diagonal, of which a dependent constraint has hardly anything left


class Step(NamedTuple):
    """Decided step: z += length column, then the pivot T -= left right'."""

    index: Int[Array, ""]  # the constraint whose prescribed quantity changes by ``length``
    length: Float[Array, ""]
    column: Float[Array, " m"]
    pivot: Int[Array, ""]  # the constraint that becomes active or inactive; -1 for none
    label: Int[Array, ""]  # its new label in the active set
    left: Float[Array, " m"]
    right: Float[Array, " m"]


class DualState(NamedTuple):
    """Iterate of the dual method for one problem."""

    tableau: Float[Array, "m m"]
    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]  # positive at a lower bound, negative at an upper
    active: Int[Array, " m"]
    redundant: Bool[Array, " m"]  # dependent on the active constraints, which imply them
    infeasible: Bool[Array, ""]  # a dependent constraint contradicts the active ones, and the search ended there
    entering: Int[Array, ""]  # the constraint being activated, -1 for none
    iterations: Int[Array, ""]
    searching: Bool[Array, ""]
    step: Step


def initial_state(
    tableau: Float[Array, "m m"], value: Float[Array, " m"], multiplier: Float[Array, " m"], active: Int[Array, " m"]
) -> DualState:
    """Return the state for given tableau, values, multipliers and active set, before the first step."""
    zero, zeros = jnp.asarray(0, jnp.int32), jnp.zeros_like(value)
    return DualState(
        tableau=tableau,
        value=value,
        multiplier=multiplier,
        active=active,
        redundant=jnp.zeros(len(value), bool),
        infeasible=jnp.asarray(False),
        entering=zero - 1,
        iterations=zero,
        searching=jnp.asarray(True),
        step=Step(zero, jnp.zeros((), value.dtype), zeros, zero - 1, zero, zeros, zeros),
    )


def dual_active_set(
    constraints: Constraints,
    start: DualState,
    *,
    searching: Bool[Array, " B"],
    iterations: Int[Array, " B"],
    max_iterations: int,
) -> DualState:
    """Find the active sets of a batch; every argument has a leading axis of problems.

    ``iterations`` has the changes of the active set so far, ``max_iterations`` limits them; other problems than those
    that are ``searching`` stay as they are.
    """

    def is_running(state: DualState) -> Bool[Array, ""]:
        return jnp.any(state.searching & (state.iterations < max_iterations))

    def repeat(decide: Callable[..., DualState], state: DualState) -> DualState:
        one = jax.vmap(lambda constraints, s: decide(constraints, _apply_step(constraints, s)))
        # twice, so that no update works in place: on a CPU, in-place loops are not vectorised
        return jax.lax.while_loop(is_running, lambda s: one(constraints, one(constraints, s)), state)

    dual_feasible = repeat(_drop_wrong_sign, start._replace(searching=searching, iterations=iterations))
    end = repeat(_add_violated, dual_feasible._replace(searching=searching))
    return jax.vmap(_apply_step)(constraints, end)


def _apply_step(constraints: Constraints, s: DualState) -> DualState:
    """Apply the decided step."""
    step, order = s.step, jnp.arange(len(s.value))
    is_active = s.active != INACTIVE
    # the prescribed quantity (y of an inactive, s of an active constraint) changes by the length, the others follow
    prescribed = jnp.where(order == step.index, step.length, 0.0)
    followed = step.length * step.column
    at_pivot = order == step.pivot
    active = jnp.where(at_pivot, step.label, s.active)
    value = s.value + jnp.where(is_active, prescribed, followed)
    bound = jnp.where(active == AT_UPPER, constraints.upper, constraints.lower)
    multiplier = s.multiplier + jnp.where(is_active, followed, prescribed)
    return s._replace(
        tableau=s.tableau - step.left[:, None] * step.right[None, :],
        # a constraint that has become active is at its bound to the last bit
        value=jnp.where(at_pivot & (active != INACTIVE), bound, value),
        multiplier=jnp.where(active == INACTIVE, jnp.where(order == s.entering, multiplier, 0.0), multiplier),
        active=active,
    )


def _drop_wrong_sign(constraints: Constraints, s: DualState) -> DualState:
    """Deactivate the constraint with the most wrongly signed multiplier, if there is one."""
    signed = jnp.where(s.active == AT_LOWER, s.multiplier, jnp.where(s.active == AT_UPPER, -s.multiplier, 0.0))
    wrong = jnp.where(signed < -constraints.roundoff.multiplier, signed, 0.0)
    j = first_smallest(wrong)
    moves = s.searching & (wrong[j] < 0.0)
    is_active = s.active != INACTIVE
    row = s.tableau[j]
    # the change of the value with which the multiplier reaches 0
    length = jnp.where(moves, -s.multiplier[j] / jnp.where(moves, row[j], 1.0), 0.0)
    step = Step(
        j,
        length,
        jnp.where(is_active == is_active[j], row, -row),
        jnp.where(moves, j, -1),
        jnp.asarray(INACTIVE, jnp.int32),
        *principal_pivot(s.tableau, j, is_active, moves),
    )
    return s._replace(step=step, iterations=s.iterations + moves, searching=moves)


class _Entering(NamedTuple):
    """Violated constraint that a dual step makes active."""

    index: Int[Array, ""]
    exists: Bool[Array, ""]
    below: Bool[Array, ""]  # its lower bound is violated, not its upper one
    gap: Float[Array, ""]  # how far it is outside its interval


def _add_violated(constraints: Constraints, s: DualState) -> DualState:
    """Decide on one dual step towards a violated constraint, which is kept until it holds (GI, step 1).

    Equalities come first.
    """
    entering = _entering_constraint(constraints, s)
    k, enters = entering.index, entering.exists
    is_active = s.active != INACTIVE
    row = s.tableau[k]
    column = jnp.where(is_active, -row, row)
    sign = jnp.where(entering.below, 1.0, -1.0).astype(row.dtype)
    full = _full_step(constraints, row, entering)
    partial, leaving = _partial_step(s, sign, column)

    # t = min(t1, t2) (GI, step 2): constraint ``leaving`` is dropped or constraint k is added; infeasible if infinite
    drops = partial < full
    length = jnp.minimum(partial, full)
    stuck = jnp.isinf(length)
    moves = enters & ~stuck
    is_redundant = entering.gap <= REDUNDANCY_TOL[row.dtype] * constraints.roundoff.value[k]
    pivot = jnp.where(drops, leaving, k)
    at_bound = jnp.where(constraints.equality[k], EQUALITY, jnp.where(entering.below, AT_LOWER, AT_UPPER))
    label = jnp.where(drops, INACTIVE, at_bound)
    step = Step(
        k,
        jnp.where(moves, sign * length, 0.0),
        column,
        jnp.where(moves, pivot, -1),
        label.astype(jnp.int32),
        *principal_pivot(s.tableau, pivot, is_active, moves),
    )
    return s._replace(
        step=step,
        redundant=s.redundant | ((jnp.arange(len(row)) == k) & enters & stuck & is_redundant),
        infeasible=s.infeasible | (enters & stuck & ~is_redundant),
        entering=jnp.where(moves & drops, k, -1),
        iterations=s.iterations + enters,
        searching=enters & (moves | is_redundant),
    )


def _entering_constraint(constraints: Constraints, s: DualState) -> _Entering:
    """Return the constraint being activated, or else the one whose activation raises the dual objective most."""
    eps = jnp.finfo(s.value.dtype).eps
    below_by, above_by = constraints.lower - s.value, s.value - constraints.upper
    violation = jnp.maximum(below_by, above_by)
    is_violated = (violation > constraints.roundoff.value) | constraints.equality
    may_enter = (s.active == INACTIVE) & ~s.redundant & is_violated
    # a full step to s_k = bound raises the dual objective by half of violation^2 / T_kk
    gain = jnp.maximum(violation, 0.0) ** 2 / jnp.maximum(jnp.diagonal(s.tableau), eps * constraints.scale)
    gain = jnp.where(may_enter, jnp.where(constraints.equality, jnp.inf, gain), -1.0)
    best = first_smallest(-gain)
    is_pending = s.entering >= 0
    k = jnp.where(is_pending, s.entering, best)
    exists = s.searching & (is_pending | (gain[best] >= 0.0))
    # which bound is the nearer, not which is violated: on its way, rounding may have taken it over its bound
    return _Entering(k, exists, below_by[k] >= above_by[k], jnp.maximum(below_by[k], above_by[k]))


def _full_step(constraints: Constraints, row: Float[Array, " m"], entering: _Entering) -> Float[Array, ""]:
    """Return the full (primal) step length t2 of GI; infinite if constraint k depends on the active constraints."""
    k, eps = entering.index, jnp.finfo(row.dtype).eps
    independent = row[k] > DEPENDENCE_TOL * eps * constraints.scale[k]
    return jnp.where(independent, jnp.maximum(entering.gap, 0.0) / jnp.where(independent, row[k], 1.0), jnp.inf)


def _partial_step(
    s: DualState, sign: Float[Array, ""], column: Float[Array, " m"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Return the partial (dual) step length t1 (Goldfarb, Idnani), and the inequality that leaves the active set there.

    Beyond t1 the multiplier of that inequality would have the wrong sign; t1 is infinite if there is none. ``sign`` is
    that of the entering constraint's multiplier; ``column`` has the rates of all values and multipliers per unit of it.
    """
    bound_sign = jnp.where(s.active == AT_LOWER, 1.0, jnp.where(s.active == AT_UPPER, -1.0, 0.0)).astype(column.dtype)
    rate = bound_sign * sign * column
    blocks = rate < 0.0
    steps = jnp.where(blocks, jnp.maximum(bound_sign * s.multiplier, 0.0) / jnp.where(blocks, -rate, 1.0), jnp.inf)
    leaving = first_smallest(steps)
    return steps[leaving], leaving


def principal_pivot(
    tableau: Float[Array, "m m"], k: Int[Array, ""], is_active: Bool[Array, " m"], moves: Bool[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return left and right of the rank-1 update that exchanges value and multiplier of constraint k.

    The tableau after it is T - (T e_k + e_k)(e_k' T - e_k') / T_kk. T_ij = T_ji but for a sign where one of i, j is
    active and the other is not, so the row gives the column. Both are such that nothing changes where ``moves`` is not.
    """
    row = tableau[k]
    at_k = (jnp.arange(len(row)) == k).astype(row.dtype)
    column = jnp.where(is_active == is_active[k], row, -row)
    return jnp.where(moves, (column + at_k) / jnp.where(moves, row[k], 1.0), 0.0), row - at_k
