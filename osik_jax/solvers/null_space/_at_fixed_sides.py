"""The derivative of saturation in the null space: the levels computed anew with the saturated joints where they are.

Where no joint is about to saturate or to be released, x and the scale solve linear equations: the saturated joints of a
level sit on their bounds, and where the level is scaled down, the joints that stop it say by how much. Two
factorisations a level solve them, whose derivatives are known in closed form; nothing of the search is differentiated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._rules import custom_jvp
from .._backends import Backend
from .._damping import room_below
from .._dense import apply, product
from ._padded import Problem, first_room
from ._projection import damped_part, level_motion
from ._search import Room, blocked_scale


class Decision(NamedTuple):
    """What one level decided."""

    done: Bool[Array, ""]
    side: Int[Array, " n"]  # -1 saturated on the lower bound, 1 on the upper, 0 free
    blocking: Int[Array, " n"]  # the joints that stop the level, likewise
    blocker: Int[Array, ""]  # the one of them whose place the others say


_DEPENDENT = 1e-7
"""A saturated joint that the others leave less of its column of the projector has no derivative of its own."""

Answer = tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, " L"]]
"""x, the projector, and the scales."""


def with_derivative(answer: Answer, decisions: Decision, problem: Problem, backend: Backend = "jax") -> Answer:
    """The answer as it is, with the derivatives of the linear equations that hold at these decisions."""
    return _attach(jax.lax.stop_gradient(answer), decisions, problem, backend=backend)


@custom_jvp
def _attach(answer: Answer, decisions: Decision, problem: Problem, *, backend: Backend) -> Answer:
    return answer


@_attach.defjvp
def _attach_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, backend: Backend) -> tuple[Answer, Answer]:
    answer, decisions, problem = primals
    _, rates = jax.jvp(lambda p: _descend(decisions, p, backend), (problem,), (tangents[-1],))
    # not the answer alone: the next derivative needs this rule
    return _attach(answer, decisions, problem, backend=backend), rates


def _descend(decisions: Decision, problem: Problem, backend: Backend) -> Answer:
    def level(state: tuple[Array, ...], each: tuple[Any, ...]) -> tuple[tuple[Array, ...], Array]:
        decision, rows, damping, target = each
        start, projector, lower, upper, bent = state
        motion, projector, strength = level_motion(rows, start, projector, damping, problem.rank, backend)
        x, projector, scale = _level(decision, Room(start, motion, target, projector, lower, upper))
        part = damped_part(rows, start, x, strength, problem.rank)
        x, scale = start + part * (x - start), part * scale
        return (x, projector, *room_below(damping, rows, bent, x, lower, upper)), scale

    across = decisions, problem.rows, problem.damping, problem.targets
    start = *first_room(problem), problem.lower, problem.upper, jnp.zeros_like(problem.lower)
    (x, projector, *_), scales = jax.lax.scan(level, start, across)
    return x, projector, scales


def _level(decision: Decision, room: Room) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """x, the projector, and the scale."""
    scale, projector = _stop(room, decision)
    # one factorisation after another: see osik_jax/runtime.py
    scale, side = jax.lax.optimization_barrier((scale, decision.side))
    x = jnp.where(side != 0, room.bound(side), _settle(room, scale, side, _dual_basis(room.projector, side)))
    return jnp.where(decision.done, x, room.start), projector, jnp.where(decision.done, scale, 0.0)


def _stop(room: Room, decision: Decision) -> tuple[Float[Array, ""], Float[Array, "n n"]]:
    """The scale, and the projector without the joints that stop the motion.

    The blocker's column of the projector is the sum of the others' with their shares, so that the same combination of
    x does not depend on what the null space does.
    """
    blocking, blocker = decision.blocking, decision.blocker
    others = blocking.at[blocker].set(0)
    dual = _dual_basis(room.projector, others)
    shares = apply(dual, room.projector[:, blocker])
    normal = (-shares).at[blocker].set(1.0)
    blocked = (blocking != 0).any()
    scale = jnp.where(blocked, blocked_scale(room, blocking, normal), 1.0)
    columns = jnp.where(others != 0, room.projector, 0.0)
    reduced = room.projector - product(room.projector, product(product(columns, dual), room.projector))
    keep = (blocking == 0)[:, None] & (blocking == 0)[None, :]
    return scale, jnp.where(keep, _purified(reduced), 0.0)


@custom_jvp
def _dual_basis(projector: Float[Array, "n n"], side: Int[Array, " n"]) -> Float[Array, "n n"]:
    """C, the pseudo-inverse of the projector's columns of the saturated joints; its rows of the free ones are 0.

    C' (bound - x) takes the saturated joints to their bounds, by the smallest step in the projector's range.
    """
    order = jnp.argsort(side == 0, stable=True)
    valid = side[order] != 0
    basis, triangle = jnp.linalg.qr(jnp.where(valid, projector[:, order], 0.0))
    eye = jnp.eye(len(side), dtype=projector.dtype)
    valid = valid & (jnp.abs(jnp.diagonal(triangle)) > _DEPENDENT)
    both = valid[:, None] & valid[None, :]
    inverse = jax.scipy.linalg.solve_triangular(jnp.where(both, triangle, eye), eye)
    dual = product(jnp.where(both, inverse, 0.0), jnp.where(valid, basis, 0.0).T)
    return jnp.zeros_like(dual).at[order].set(dual)


@_dual_basis.defjvp
def _dual_basis_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Any]) -> tuple[Array, Array]:
    """G. H. Golub, V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973, for a matrix of full column rank."""
    projector, side = primals
    dual = _dual_basis(projector, side)
    columns, moved = (jnp.where(side != 0, matrix, 0.0) for matrix in (projector, tangents[0]))
    rest = moved.T - product(product(moved.T, columns), dual)
    return dual, product(dual, product(dual.T, rest)) - product(dual, product(moved, dual))


def _settle(room: Room, scale: Array, side: Int[Array, " n"], dual: Float[Array, "n n"]) -> Float[Array, " n"]:
    """x with the saturated joints on their bounds, refined once."""
    x = room.unsaturated(scale)
    for _ in range(2):
        step = apply(dual.T, jnp.where(side != 0, room.bound(side) - x, 0.0))
        x = x + apply(room.projector, step)
    return x


def _purified(projector: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """3 P^2 - 2 P^3 of a symmetric P: eigenvalues at a distance e from 0 or 1 come as near as 3 e^2."""
    projector = 0.5 * (projector + projector.T)
    square = product(projector, projector)
    return 3.0 * square - 2.0 * product(square, projector)
