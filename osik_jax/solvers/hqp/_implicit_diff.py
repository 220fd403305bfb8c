"""Implicit differentiation of a hierarchy at the fixed active sets of its solution.

Where no active set is about to change, the solution map is that of a cascade of equality-constrained least squares: at
each level the frozen hard rows stay at their bounds, and the rows in the cost come as near to theirs as the levels
above allow (docs/dev/derivations.md, "Implicit derivatives"). The cascade takes one pseudo-inverse for each block of
rows, whose derivative at constant rank is known in closed form. The search is not differentiated, so memory does not
grow with its iterations.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...execution._backends import Backend
from ...execution._rules import custom_jvp
from ...numerics._dense import apply, product
from .._damping import Damping, HardRows, level_damping, narrow_box
from .._inverses import row_space_and_motion
from .._level import PaddedLevel
from ._problem import PaddedHierarchy


class ActiveSets(NamedTuple):
    """Active sets at the optimum of one level: -1 at the lower bound, 1 at the upper, 0 inactive."""

    active: Int[Array, " h"]  # hard rows that stop the level
    frozen: Int[Array, " h"]  # those of them that are frozen for the levels below
    in_cost: Int[Array, " m"]  # the level's own rows in its cost, and the bound that they miss
    rank: Int[Array, ""]  # of the rows in the cost, within what the frozen rows leave free


def with_derivative(
    x: Float[Array, " n"],
    active_sets: ActiveSets,
    hierarchy: PaddedHierarchy,
    singular_tol: Float[Array, ""],
    backend: Backend,
) -> Float[Array, " n"]:
    """Return ``x`` unchanged, with the derivatives of the cascade at fixed active sets.

    Singular values up to ``singular_tol`` times the longest row are 0, whatever the rank of the active sets.
    """
    return _attach(jax.lax.stop_gradient(x), active_sets, singular_tol, hierarchy, backend=backend)


@custom_jvp
def _attach(
    x: Array, active_sets: ActiveSets, singular_tol: Array, hierarchy: PaddedHierarchy, *, backend: Backend
) -> Array:
    return x


@_attach.defjvp
def _attach_jvp(primals: tuple, tangents: tuple, *, backend: Backend) -> tuple[Array, Array]:
    x, active_sets, singular_tol, hierarchy = primals
    *_, rates = tangents
    _, dx = jax.jvp(partial(_solve_at_active_sets, active_sets, singular_tol, backend), (hierarchy,), (rates,))
    # not x alone: the second derivative needs this rule again
    return _attach(x, active_sets, singular_tol, hierarchy, backend=backend), dx


def _solve_at_active_sets(
    active_sets: ActiveSets, singular_tol: Float[Array, ""], backend: Backend, hierarchy: PaddedHierarchy
) -> Float[Array, " n"]:
    """Return the answer of the equality-constrained least-squares cascade defined by the active sets."""
    n = hierarchy.hard.shape[1]
    pinned = hierarchy.hard_is_equality[:n]

    def solve_level(
        state: tuple[Array, ...], now: tuple[Array, ActiveSets, PaddedLevel, Damping]
    ) -> tuple[tuple[Array, ...], None]:
        k, sets, level, terms = now
        x, projector, low, high, curvature = state
        hard = hierarchy.hard, hierarchy.hard_lower.at[:n].set(low), hierarchy.hard_upper.at[:n].set(high)
        # rows in the cost of a level above depend on what is frozen, and stop nothing
        above = HardRows(
            hierarchy.hard[n:],
            jnp.where(hierarchy.hard_level < k, hierarchy.hard_lower, -jnp.inf)[n:],
            jnp.where(hierarchy.hard_level < k, hierarchy.hard_upper, jnp.inf)[n:],
        )
        damping = level_damping(terms, level, x, projector, low, high, above)
        # the level moves within what all active rows leave free; below it only the frozen ones are equalities
        fit = partial(_fit_rows, singular_tol, backend)
        x, free = fit(*_active_first(*hard, sets.active), None, x, projector)
        _, free_below = fit(*_active_first(*hard, sets.frozen), None, x, projector)
        own = level.matrix, level.lower, level.upper, sets.in_cost, sets.rank
        x, _ = fit(*own, x, free, damping)
        _, free_below = fit(*own, x, free_below)
        return (x, free_below, *narrow_box(terms, level, curvature, x, low, high)), None

    box = hierarchy.hard_lower[:n], hierarchy.hard_upper[:n]
    start = (
        jnp.where(pinned, box[0], 0.0),
        jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(hierarchy.hard.dtype)),
        *box,
        jnp.zeros_like(box[0]),
    )
    numbers = jnp.arange(len(hierarchy.levels.lower))
    return jax.lax.scan(solve_level, start, (numbers, active_sets, hierarchy.levels, hierarchy.damping))[0][0]


def _active_first(matrix: Array, lower: Array, upper: Array, active: Array) -> tuple[Array, Array, Array, Array]:
    """Return as many hard rows as variables, active ones first; independent active rows are never more than that."""
    rows = jnp.argsort(active == 0, stable=True)[: matrix.shape[1]]
    return matrix[rows], lower[rows], upper[rows], active[rows]


def _fit_rows(
    singular_tol: Float[Array, ""],
    backend: Backend,
    matrix: Float[Array, "k n"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
    active: Int[Array, " k"],
    rank: Array | None,
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
    damping: Float[Array, ""] | None = None,
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Move x within the projector's range to bring the active rows nearest to their bounds.

    With C the active rows times the projector P and g what they miss, the motion is ``C^+ g``, with a pseudo-inverse of
    the given rank at most, if one is given. With damping it minimises ``|C d - g|^2 + damping |x + d|^2``. Return the
    new x, and the projector without the row space of C.
    """
    is_active = active != 0
    # a bound that is not active may be infinite: it is masked, and the terms are added
    target = jnp.where(active < 0, lower, 0.0) + jnp.where(active > 0, upper, 0.0)
    chosen = jnp.where(is_active[:, None], matrix, 0.0)
    # a cutoff decides on the rank alone: no derivative goes through it
    longest = jnp.max(jnp.abs(jax.lax.stop_gradient(chosen)))
    gap = jnp.where(is_active, target - apply(chosen, x), 0.0)
    rows, cutoff = product(chosen, projector), singular_tol * longest
    space, motion = row_space_and_motion(rows, gap, cutoff, jnp.zeros_like(cutoff), rank, backend=backend)
    if damping is not None:
        is_damped = damping > 0.0
        damping = jnp.where(is_damped, damping, 1.0)
        _, whole = row_space_and_motion(rows, gap + apply(rows, x), cutoff, damping, None, backend=backend)
        # the damped minimiser does not depend on x: all of x in the projector's range is replaced
        motion = jnp.where(is_damped, whole - x, motion)
    # rounding over small singular values has components outside the projector's range, so both are projected (eq. 7)
    return x + apply(projector, motion), projector - product(projector, product(space, projector))
