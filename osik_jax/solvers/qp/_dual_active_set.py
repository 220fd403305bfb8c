"""Finds the active set of a strictly convex QP: the dual method of Goldfarb and Idnani on a pivoting tableau.

The method starts at the unconstrained minimiser, takes the constraint whose activation raises the dual objective
most, and moves along the dual until that constraint holds or the multiplier of an active one reaches zero; the dual
objective never falls, so no active set returns and there is no cycling (D. Goldfarb, A. Idnani, "A numerically stable
dual method for solving strictly convex quadratic programs", Mathematical Programming 27, 1983).

State is one matrix over the m = n + p constraints. With M = [I; C] H^-1 [I; C]', constraint values s and multipliers
y obey s = s_0 + M y; exchanging the roles of s_k and y_k (a principal pivot) makes constraint k active or inactive.
Every step is one rank-1 update of that matrix, whatever the active set: static shapes, and no factorisation to redo.

When not to use it: H only semidefinite (add damping), or thousands of rows (the tableau is dense).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from ._problem import AT_LOWER, AT_UPPER, EQUALITY, INACTIVE, QP


class _State(NamedTuple):
    tableau: Float[Array, "m m"]
    value: Float[Array, " m"]  # s: value of each constraint at the present point
    multiplier: Float[Array, " m"]  # y: positive pushes up from a lower bound, negative down from an upper
    active: Int[Array, " m"]
    impossible: Bool[Array, " m"]  # constraints that contradict those active
    entering: Int[Array, ""]  # the constraint being activated, -1 for none
    iterations: Int[Array, ""]
    searching: Bool[Array, ""]


class ActiveSet(NamedTuple):
    """Which constraints hold with equality, and how it was found."""

    active: Int[Array, " m"]
    impossible: Bool[Array, " m"]
    iterations: Int[Array, ""]
    settled: Bool[Array, ""]


def find_active_set(qp: QP, max_iterations: int, tolerance: Float[Array, ""]) -> ActiveSet:
    """The active set of the optimum.

    Args:
        qp: the problem; H positive definite.
        max_iterations: greatest number of constraints added and dropped (static).
        tolerance: a constraint is violated when it is so by more than this times the scale of its values.
    """
    start = _unconstrained(qp)
    scale = jnp.diagonal(start.tableau)
    slack = tolerance * (1.0 + jnp.abs(start.value))

    def go_on(state: _State) -> Bool[Array, ""]:
        return state.searching & (state.iterations < max_iterations)

    def body(state: _State) -> _State:
        return _choose(qp, _step(qp, state, scale), scale, slack)

    end = jax.lax.while_loop(go_on, body, _choose(qp, start, scale, slack))
    return ActiveSet(end.active, end.impossible, end.iterations, ~end.searching)


def _unconstrained(qp: QP) -> _State:
    n, m = qp.hessian.shape[0], qp.lower.shape[0]
    normals = jnp.concatenate([jnp.eye(n, dtype=qp.hessian.dtype), qp.rows])
    factor = jnp.linalg.cholesky(qp.hessian)
    sides = jnp.concatenate([normals.T, qp.gradient[:, None]], 1)  # one triangular solve for both
    solved = jax.scipy.linalg.solve_triangular(factor, sides, lower=True)
    half, offset = solved[:, :-1], solved[:, -1]
    return _State(
        tableau=product(half.T, half),
        value=-apply(half.T, offset),
        multiplier=jnp.zeros(m, qp.hessian.dtype),
        active=jnp.full(m, INACTIVE, jnp.int32),
        impossible=jnp.zeros(m, bool),
        entering=jnp.asarray(-1),
        iterations=jnp.asarray(0),
        searching=jnp.asarray(True),
    )


def _choose(qp: QP, state: _State, scale: Float[Array, " m"], slack: Float[Array, " m"]) -> _State:
    """Keeps the entering constraint, or takes the violated one that raises the dual most; equalities come first."""
    violation = jnp.maximum(qp.lower - state.value, state.value - qp.upper)
    candidate = (state.active == INACTIVE) & ~state.impossible & ((violation > slack) | qp.equality)
    curvature = jnp.maximum(jnp.diagonal(state.tableau), jnp.finfo(scale.dtype).eps * scale)
    gain = jnp.where(candidate, violation**2 / curvature, -1.0)
    gain = jnp.where(candidate & qp.equality, jnp.inf, gain)
    best = jnp.argmax(gain)
    found = candidate[best]
    pending = state.entering >= 0
    entering = jnp.where(pending, state.entering, jnp.where(found, best, -1))
    return state._replace(entering=entering, searching=pending | found)


def _step(qp: QP, state: _State, scale: Float[Array, " m"]) -> _State:
    """One dual step: activate the entering constraint, or drop the active one that blocks the way."""
    k = state.entering
    column = state.tableau[:, k]
    below = state.value[k] < qp.lower[k]
    sign = jnp.where(below, 1.0, -1.0).astype(column.dtype)
    gap = jnp.where(below, qp.lower[k], qp.upper[k]) - state.value[k]
    independent = column[k] > _dependent(column.dtype) * scale[k]
    full_step = jnp.where(independent, jnp.abs(gap) / jnp.where(independent, column[k], 1.0), jnp.inf)

    side = jnp.where(state.active == AT_UPPER, -1.0, 1.0)
    droppable = (state.active == AT_LOWER) | (state.active == AT_UPPER)
    pressure = jnp.maximum(side * state.multiplier, 0.0)
    rate = side * sign * column
    blocks = droppable & (rate < 0.0)
    steps = jnp.where(blocks, pressure / jnp.where(blocks, -rate, 1.0), jnp.inf)
    leaving = jnp.argmin(steps)
    partial_step = steps[leaving]

    drops = partial_step < full_step
    length = jnp.minimum(partial_step, full_step)
    stuck = jnp.isinf(length)
    move = jnp.where(stuck, 0.0, length) * sign
    held = state.active != INACTIVE
    value = state.value + jnp.where(held, 0.0, move * column)
    multiplier = state.multiplier + jnp.where(held, move * column, 0.0)
    multiplier = multiplier.at[k].add(move)
    pivot = jnp.where(drops, leaving, k)
    multiplier = multiplier.at[leaving].set(jnp.where(drops, 0.0, multiplier[leaving]))
    label = jnp.where(qp.equality[k], EQUALITY, jnp.where(below, AT_LOWER, AT_UPPER))
    active = state.active.at[pivot].set(jnp.where(stuck, state.active[pivot], jnp.where(drops, INACTIVE, label)))
    return state._replace(
        tableau=jnp.where(stuck, state.tableau, _principal_pivot(state.tableau, pivot)),
        value=value,
        multiplier=jnp.where(stuck, multiplier.at[k].set(0.0), multiplier),
        active=active,
        # an equality that the active ones imply is left out silently: it is impossible only where a gap remains
        impossible=state.impossible.at[k].set(state.impossible[k] | stuck),
        entering=jnp.where(drops & ~stuck, k, -1),
        iterations=state.iterations + 1,
    )


def _dependent(dtype: jnp.dtype) -> float:
    """A normal whose part outside the span of the active ones falls under this share of itself depends on them."""
    return 100.0 * float(jnp.finfo(dtype).eps)


def _principal_pivot(tableau: Float[Array, "m m"], k: Int[Array, ""]) -> Float[Array, "m m"]:
    """Exchanges value and multiplier of constraint k."""
    row, column = tableau[k, :], tableau[:, k]
    inverse = 1.0 / row[k]
    at_k = jnp.arange(len(row)) == k
    out = tableau - (column * inverse)[:, None] * row[None, :]
    out = jnp.where(at_k[:, None], -row[None, :] * inverse, out)
    out = jnp.where(at_k[None, :], column[:, None] * inverse, out)
    return jnp.where(at_k[:, None] & at_k[None, :], inverse, out)
