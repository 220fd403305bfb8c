"""Finds the active set of a strictly convex QP: the dual method of Goldfarb and Idnani on a pivoting tableau.

The method stands at the minimiser for some active set whose multipliers have the right signs (wrong ones are dropped
first), takes the violated constraint whose activation raises the dual objective most, and moves along the dual until
that constraint holds or the multiplier of an active one reaches zero. The dual objective never falls, so no active set
returns and there is no cycling (D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex
quadratic programs", Mathematical Programming 27, 1983).

State is one matrix over the m constraints. Inactive constraints have a value s and no multiplier, active ones a
multiplier y and a given value; s and y of all are an affine function of what is given, whose matrix is the tableau.
Making constraint k active or inactive exchanges s_k and y_k: one principal pivot, a rank-1 update, whatever the active
set. Static shapes, and no factorisation to redo.

An iteration decides on a step and leaves it in the carry for the next one to apply. So XLA's CPU compiler, which would
inline the decision into every element of the tableau's update, finds two vectors there.

When not to use it: thousands of rows (the tableau is dense).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._double import first_smallest

INACTIVE, AT_LOWER, AT_UPPER, EQUALITY = 0, -1, 1, 2

DEPENDENT = 100.0
"""Roundings; a constraint that the active ones leave less of itself than this depends on them."""

NO_GAP = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e1}
"""Noises; a constraint that depends on the active ones and is violated by less is implied by them."""


class Noise(NamedTuple):
    """Below these a violation or a multiplier of the wrong sign is rounding."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


class Limits(NamedTuple):
    """What the constraints ask for, in the units of the search: each constraint scaled to a unit diagonal."""

    lower: Float[Array, " m"]
    upper: Float[Array, " m"]
    equality: Bool[Array, " m"]
    noise: Noise
    scale: Float[Array, " m"]  # of the diagonal at first: what a dependent constraint's falls below


class Step(NamedTuple):
    """A decided step: z += length column, then the pivot, T -= left right'."""

    index: Int[Array, ""]  # the constraint whose given quantity changes by ``length``
    length: Float[Array, ""]
    column: Float[Array, " m"]
    pivot: Int[Array, ""]  # the constraint that becomes active or inactive; -1 for none
    label: Int[Array, ""]  # what it becomes
    left: Float[Array, " m"]
    right: Float[Array, " m"]


class Dual(NamedTuple):
    """Iterate of the dual method, one problem."""

    tableau: Float[Array, "m m"]
    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]  # positive pushes up from a lower bound, negative down from an upper
    active: Int[Array, " m"]
    implied: Bool[Array, " m"]  # constraints that those active imply
    contradicted: Bool[Array, ""]  # the search met one that those active forbid, and ended there
    entering: Int[Array, ""]  # the constraint being activated, -1 for none
    iterations: Int[Array, ""]
    searching: Bool[Array, ""]
    step: Step


def begin(
    tableau: Float[Array, "m m"], value: Float[Array, " m"], multiplier: Float[Array, " m"], active: Int[Array, " m"]
) -> Dual:
    """The state at a known point, in the units of the search."""
    zero, nothing = jnp.asarray(0, jnp.int32), jnp.zeros_like(value)
    return Dual(
        tableau=tableau,
        value=value,
        multiplier=multiplier,
        active=active,
        implied=jnp.zeros(len(value), bool),
        contradicted=jnp.asarray(False),
        entering=zero - 1,
        iterations=zero,
        searching=jnp.asarray(True),
        step=Step(zero, jnp.zeros((), value.dtype), nothing, zero - 1, zero, nothing, nothing),
    )


def search(
    limits: Limits,
    start: Dual,
    *,
    searching: Bool[Array, " B"],
    iterations: Int[Array, " B"],
    max_iterations: int,
) -> Dual:
    """The active sets of the lanes that search; every argument has a leading axis, the lanes.

    Args:
        limits: of the constraints.
        start: where the search begins.
        searching: lanes to work on.
        iterations: changes of the active set so far.
        max_iterations: cap on the changes of the active set.
    """

    def go_on(state: Dual) -> Bool[Array, ""]:
        return jnp.any(state.searching & (state.iterations < max_iterations))

    def repeat(decide: Callable[..., Dual], state: Dual) -> Dual:
        one = jax.vmap(lambda limits, s: decide(limits, _apply(limits, s)))
        # twice, so that no update works in place: on a CPU, in-place loops are not vectorised
        return jax.lax.while_loop(go_on, lambda s: one(limits, one(limits, s)), state)

    dual_feasible = repeat(_drop_wrong, start._replace(searching=searching, iterations=iterations))
    found = repeat(_add_violated, dual_feasible._replace(searching=searching))
    return jax.vmap(_apply)(limits, found)


def _apply(limits: Limits, s: Dual) -> Dual:
    """Takes the decided step."""
    step, order = s.step, jnp.arange(len(s.value))
    held = s.active != INACTIVE
    given = jnp.where(order == step.index, step.length, 0.0)
    moved = step.length * step.column
    at_pivot = order == step.pivot
    active = jnp.where(at_pivot, step.label, s.active)
    value = s.value + jnp.where(held, given, moved)
    bound = jnp.where(active == AT_UPPER, limits.upper, limits.lower)
    multiplier = s.multiplier + jnp.where(held, moved, given)
    return s._replace(
        tableau=s.tableau - step.left[:, None] * step.right[None, :],
        value=jnp.where(at_pivot & (active != INACTIVE), bound, value),
        multiplier=jnp.where(active == INACTIVE, jnp.where(order == s.entering, multiplier, 0.0), multiplier),
        active=active,
    )


def _drop_wrong(limits: Limits, s: Dual) -> Dual:
    """Makes inactive the constraint whose multiplier has the wrong sign, the worst if there are several."""
    pressure = jnp.where(s.active == AT_LOWER, s.multiplier, jnp.where(s.active == AT_UPPER, -s.multiplier, 0.0))
    wrong = jnp.where(pressure < -limits.noise.multiplier, pressure, 0.0)
    j = first_smallest(wrong)
    moves = s.searching & (wrong[j] < 0.0)
    held = s.active != INACTIVE
    row = s.tableau[j]
    length = jnp.where(moves, -s.multiplier[j] / jnp.where(moves, row[j], 1.0), 0.0)
    step = Step(
        j,
        length,
        jnp.where(held == held[j], row, -row),
        jnp.where(moves, j, -1),
        jnp.asarray(INACTIVE, jnp.int32),
        *exchange(s.tableau, j, held, moves),
    )
    return s._replace(step=step, iterations=s.iterations + moves, searching=moves)


def _add_violated(limits: Limits, s: Dual) -> Dual:
    """One dual step towards a violated constraint, kept until it holds; equalities come first."""
    unit = jnp.finfo(s.value.dtype).eps
    below_by, above_by = limits.lower - s.value, s.value - limits.upper
    violation = jnp.maximum(below_by, above_by)
    held = s.active != INACTIVE
    candidate = ~held & ~s.implied & ((violation > limits.noise.value) | limits.equality)
    gain = jnp.maximum(violation, 0.0) ** 2 / jnp.maximum(jnp.diagonal(s.tableau), unit * limits.scale)
    gain = jnp.where(candidate, jnp.where(limits.equality, jnp.inf, gain), -1.0)
    best = first_smallest(-gain)
    pending = s.entering >= 0
    k = jnp.where(pending, s.entering, best)
    enters = s.searching & (pending | (gain[best] >= 0.0))

    row = s.tableau[k]
    column = jnp.where(held, -row, row)
    below = below_by[k] >= above_by[k]  # not > 0: on its way, rounding may have taken it over its bound
    sign = jnp.where(below, 1.0, -1.0).astype(row.dtype)
    gap = jnp.maximum(below_by[k], above_by[k])
    independent = row[k] > DEPENDENT * unit * limits.scale[k]
    full = jnp.where(independent, jnp.maximum(gap, 0.0) / jnp.where(independent, row[k], 1.0), jnp.inf)

    side = jnp.where(s.active == AT_LOWER, 1.0, jnp.where(s.active == AT_UPPER, -1.0, 0.0)).astype(row.dtype)
    rate = side * sign * column
    blocks = rate < 0.0
    steps = jnp.where(blocks, jnp.maximum(side * s.multiplier, 0.0) / jnp.where(blocks, -rate, 1.0), jnp.inf)
    leaving = first_smallest(steps)
    drops = steps[leaving] < full
    length = jnp.minimum(steps[leaving], full)
    stuck = jnp.isinf(length)
    moves = enters & ~stuck
    implied = gap <= NO_GAP[row.dtype] * limits.noise.value[k]
    pivot = jnp.where(drops, leaving, k)
    label = jnp.where(drops, INACTIVE, jnp.where(limits.equality[k], EQUALITY, jnp.where(below, AT_LOWER, AT_UPPER)))
    step = Step(
        k,
        jnp.where(moves, sign * length, 0.0),
        column,
        jnp.where(moves, pivot, -1),
        label.astype(jnp.int32),
        *exchange(s.tableau, pivot, held, moves),
    )
    return s._replace(
        step=step,
        implied=s.implied | ((jnp.arange(len(row)) == k) & enters & stuck & implied),
        contradicted=s.contradicted | (enters & stuck & ~implied),
        entering=jnp.where(moves & drops, k, -1),
        iterations=s.iterations + enters,
        searching=enters & (moves | implied),
    )


def exchange(
    tableau: Float[Array, "m m"], k: Int[Array, ""], held: Bool[Array, " m"], moves: Bool[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Exchanges value and multiplier of constraint k: left and right of (T e_k + e_k)(e_k' T - e_k') / T_kk.

    That much less is the tableau after it.

    T_ij = T_ji but for a sign where one of i, j is active and the other is not, so the row gives the column.
    """
    row = tableau[k]
    at_k = (jnp.arange(len(row)) == k).astype(row.dtype)
    column = jnp.where(held == held[k], row, -row)
    return jnp.where(moves, (column + at_k) / jnp.where(moves, row[k], 1.0), 0.0), row - at_k
