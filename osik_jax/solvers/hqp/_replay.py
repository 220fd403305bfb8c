"""The derivative of a hierarchy: the cascade replayed at the active sets of its solution.

Where no active set is about to change, the solution map is that of a cascade of equality-constrained least squares:
at each level the hard rows that became tight sit at their bounds, and the rows that count sit as near to theirs as the
levels above allow. Replaying it takes one pseudo-inverse a block of rows, whose derivative at constant rank is known in
closed form; nothing of the search is differentiated, so memory does not grow with its iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._rules import custom_jvp
from .._damping import Damping, effective, room_below
from .._dense import apply, product
from .._inverses import row_space_and_motion, row_space_and_motion_of_rank
from .._level import Level
from ._stack import Stack


class Decision(NamedTuple):
    """What one level decided: 0 for rows without a part in it, -1 at the lower bound, 1 at the upper."""

    held: Int[Array, " h"]  # hard rows that stop the level at a bound
    tight: Int[Array, " h"]  # of these, those that stop the levels below too
    counts: Int[Array, " m"]  # the level's own rows that count in its cost
    rank: Int[Array, ""]  # of the rows that count, within what frozen and tight rows leave free


def with_derivative(x: Float[Array, " n"], decisions: Decision, stack: Stack, nothing: Array) -> Float[Array, " n"]:
    """``x`` as it is, with the derivatives of the replayed cascade with respect to levels and box.

    ``nothing`` is the share of the longest row up to which a singular value is none, whatever the decided rank.
    """
    return _attach(jax.lax.stop_gradient(x), decisions, nothing, stack)


@custom_jvp
def _attach(x: Array, decisions: Decision, nothing: Array, stack: Stack) -> Array:
    return x


@_attach.defjvp
def _attach_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    x, decisions, nothing, stack = primals
    *_, rates = tangents
    _, dx = jax.jvp(lambda s: _replay(decisions, nothing, s), (stack,), (rates,))
    return _attach(x, decisions, nothing, stack), dx  # not x alone: the next derivative needs this one's rule


def _replay(decisions: Decision, nothing: Array, stack: Stack) -> Float[Array, " n"]:
    n = stack.hard.shape[1]
    pinned = stack.hard_equal[:n]

    def descend(state: tuple[Array, ...], now: tuple[Decision, Level, Damping]) -> tuple[tuple[Array, ...], None]:
        decision, level, given = now
        x, projector, low, high, bent = state
        hard = stack.hard, stack.hard_lower.at[:n].set(low), stack.hard_upper.at[:n].set(high)
        damping = effective(given, level, x, projector, low, high)
        x, held = _block(*_independent(*hard, decision.held), n, x, projector, nothing)
        _, left = _block(*_independent(*hard, decision.tight), n, x, projector, nothing)
        own = level.matrix, level.lower, level.upper, decision.counts, decision.rank
        x, _ = _block(*own, x, held, nothing, damping)
        _, left = _block(*own, x, left, nothing)
        return (x, left, *room_below(given, level, bent, x, low, high)), None

    box = stack.hard_lower[:n], stack.hard_upper[:n]
    start = (
        jnp.where(pinned, box[0], 0.0),
        jnp.diag(jnp.where(pinned, 0.0, 1.0).astype(stack.hard.dtype)),
        *box,
        jnp.zeros_like(box[0]),
    )
    return jax.lax.scan(descend, start, (decisions, stack.levels, stack.damping))[0][0]


def _independent(matrix: Array, lower: Array, upper: Array, side: Array) -> tuple[Array, Array, Array, Array]:
    """As many rows as there are variables, the tight ones first: those are independent, so there are no more."""
    rows = jnp.argsort(side == 0, stable=True)[: matrix.shape[1]]
    return matrix[rows], lower[rows], upper[rows], side[rows]


def _block(
    matrix: Array,
    lower: Array,
    upper: Array,
    side: Array,
    rank: Array | int,
    x: Array,
    projector: Array,
    nothing: Array,
    damping: Array | None = None,
) -> tuple[Array, Array]:
    """Moves x in the projector's range so that the chosen rows, of that rank at most, come nearest to their bounds.

    With damping, what is least is the sum of squares of what they miss and of damping |x|^2.
    """
    on = side != 0
    target = jnp.where(side < 0, _finite(lower, side < 0), _finite(upper, side > 0))
    chosen = jnp.where(on[:, None], matrix, 0.0)
    longest = jnp.max(jnp.abs(jax.lax.stop_gradient(chosen)))
    gap = jnp.where(on, target - apply(chosen, x), 0.0)
    rows, cutoff = product(chosen, projector), nothing * longest
    space, motion = row_space_and_motion_of_rank(rows, gap, rank, cutoff)
    if damping is not None:
        damped = damping > 0.0
        _, whole = row_space_and_motion(rows, gap + apply(rows, x), cutoff, jnp.where(damped, damping, 1.0))
        motion = jnp.where(damped, whole - x, motion)
    # as in the projection (eq. 7): rounding over small singular values has left the projector's range
    return x + apply(projector, motion), projector - product(projector, product(space, projector))


def _finite(bound: Array, used: Array) -> Array:
    return jnp.where(used, bound, 0.0)
