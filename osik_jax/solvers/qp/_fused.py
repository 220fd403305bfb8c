"""The search for the active set on a GPU: a kernel proposes, XLA certifies, and what is left goes to the search.

Only what the check certifies is taken from the kernel, so answers do not rest on it. The check is the search's own, on
data read anew; it costs two passes over the rows where a factorisation by XLA costs more than everything else. The
lanes that fail it are gathered into blocks, and each block goes through the search until it is done.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply
from .._lanes import in_lanes
from .._pivots import EQUALITY, INACTIVE, Noise
from . import _kernel
from ._cost import LeastSquares
from ._kernel import Proposal
from ._problem import QP, active_targets
from ._search import Found, optimal_on, possible, scales_of, search

SWITCH = "OSIK_FUSED"
"""Environment variable; 0 keeps to XLA. It is read when a program is traced."""
_SHARE, _SMALLEST = 16, 1024
"""Lanes that are left are solved in blocks of a 16th of the batch, of 1,024 lanes at least."""

_NEARLY, _SIGN = 30.0, 2.0
"""Tolerances that a certified value may be off its bound by, or a slope off nought; and a multiplier of the wrong sign.

Less is allowed of the last: such a multiplier says that the active set is not right, and what that costs is more the
weaker the curvature is that the rows leave."""

Propose = Callable[[QP, Array, Array, int], Proposal]


@cache
def searcher(max_iterations: int, gives_way: bool) -> Callable[[QP, Array, Array], Found]:
    """The search for one problem, with a cap on the changes of the active set.

    Args:
        max_iterations: the cap.
        gives_way: whether rows may give way; where all are hard, the kernel is not asked.
    """
    return in_lanes(lambda qp, guess, tolerance: _search_anywhere(qp, guess, tolerance, max_iterations, gives_way))


def _search_anywhere(qp: QP, guess: Array, tolerance: Array, cap: int, gives_way: bool) -> Found:
    plain = partial(search, max_iterations=cap)
    if not (gives_way and _fits(qp) and _wanted()):
        return plain(qp, guess, tolerance)
    fused = partial(proposed_and_searched, propose=_kernel.propose, max_iterations=cap)
    return jax.lax.platform_dependent(qp, guess, tolerance, cuda=fused, default=plain)


def _wanted() -> bool:
    return os.environ.get(SWITCH, "1") != "0" and find_spec("warp") is not None and _kernel.available()


def _fits(qp: QP) -> bool:
    """Whether the kernel is for such problems."""
    if not isinstance(qp.cost, LeastSquares) or qp.lower.dtype != jnp.float32:
        return False
    _, m, n = qp.cost.matrix.shape
    return _kernel.Shape(n, m, qp.rows.shape[1]).warps > 0


def proposed_and_searched(
    qp: QP, guess: Int[Array, "B m"], tolerance: Float[Array, " B"], *, propose: Propose, max_iterations: int
) -> Found:
    """Proposals where they are certified, the search elsewhere.

    Args:
        qp: the problems; every array has a leading axis, the lanes.
        guess: of their active sets.
        tolerance: violation that counts as none.
        propose: proposes active sets and the minimisers on them.
        max_iterations: cap on the changes of the active set.
    """
    start = jax.vmap(possible)(qp, guess)
    proposal = propose(qp, start, tolerance, max_iterations)
    found = _found(qp, proposal)
    fine = (proposal.settled != 0) & (proposal.iterations <= max_iterations)
    fine &= jax.vmap(_certified)(qp, found, tolerance)
    found = found._replace(done=fine, optimal=fine)
    lanes = len(tolerance)
    block = min(lanes, max(_SMALLEST, -(-lanes // _SHARE)))

    def body(found: Found) -> Found:
        (at,) = jnp.nonzero(~found.done, size=block, fill_value=lanes)
        at_most = jnp.minimum(at, lanes - 1)
        part = jax.tree.map(lambda a: a[at_most], (qp, found.active, tolerance))
        end = search(*part, max_iterations=max_iterations)
        end = end._replace(
            done=jnp.ones_like(end.done), factorizations=end.factorizations + found.factorizations[at_most]
        )
        return jax.tree.map(lambda all_, new: all_.at[at].set(new, mode="drop"), found, end)

    return jax.lax.while_loop(lambda found: ~jnp.all(found.done), body, found)


def _found(qp: QP, proposal: Proposal) -> Found:
    """The proposal as the end of a search."""
    nothing = jnp.zeros_like(proposal.iterations)
    return Found(
        x=proposal.x,
        row_multipliers=proposal.row_multipliers,
        active=proposal.active,
        implied=jnp.zeros(proposal.active.shape, bool),
        iterations=proposal.iterations,
        factorizations=proposal.factorizations,
        done=nothing.astype(bool),
        optimal=nothing.astype(bool),
        contradictions=nothing,
        infeasible=nothing.astype(bool),
        compliance=qp.compliance,
    )


def _certified(qp: QP, found: Found, tolerance: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether x and y are the answer: on the active bounds, stationary elsewhere, right signs, nothing crossed."""
    x, y, active = found.x, found.row_multipliers, found.active
    n = len(x)
    held = active != INACTIVE
    scales = scales_of(qp, qp.cost.diagonal(), x, y)
    noise = Noise(_NEARLY * tolerance * scales.value, _SIGN * tolerance * scales.multiplier)
    slope = qp.cost.gradient(x) - apply(qp.rows.T, y)
    off = jnp.concatenate([x, apply(qp.rows, x) + qp.compliance * y]) - active_targets(qp, active)
    known = (jnp.abs(active) == 1) | ~held | ((active == EQUALITY) & qp.equality)
    on_bounds = jnp.where(held, jnp.abs(off) <= noise.value, known)
    flat = jnp.where(
        held, known, jnp.concatenate([jnp.abs(slope) <= _NEARLY * tolerance * scales.multiplier[:n], y == 0.0])
    )
    sound = jnp.isfinite(x).all() & jnp.isfinite(y).all() & on_bounds.all() & flat.all()
    return sound & optimal_on(qp, found, x, y, noise)
