"""The search for the active set: a kernel proposes, XLA certifies, and what is left goes to the search.

Only what the check certifies is taken from the kernel, so answers do not rest on it. The check is the search's own, on
data read anew; it costs two passes over the rows where a factorisation by XLA costs more than everything else. The
lanes that fail it are gathered into blocks, and each block goes through the search until it is done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._backends import Backend, on_platforms, takes
from .._dense import apply
from .._double import in_double
from .._lanes import in_lanes, with_a_few, with_the_rest
from .._pivots import EQUALITY, INACTIVE, Noise
from . import _cpu_kernel, _kernel
from ._cost import LeastSquares
from ._factor import system_inverse
from ._kernel import Proposal
from ._problem import CERTIFIED, QP, active_targets, forces, kkt_residual, scales_of
from ._search import Found, optimal_on, possible, search, unsearched

_SHARE, _SMALLEST = 16, 1024
"""Lanes that are left are solved in blocks of a 16th of the batch, of 1,024 lanes at least."""

_SINGLE = 1e-7
"""Tolerance of the kernel, whose arithmetic is single, and of its certificate; the search has the one asked for."""

_TIGHTEST = 1e-7
"""Tolerance of the kernel where there are no bounds that a point could be near."""

_NEARLY, _SIGN = 30.0, 2.0
"""Tolerances that a certified value may be off its bound by, or a slope off nought; and a multiplier of the wrong sign.

Less is allowed of the last: such a multiplier says that the active set is not right, and what that costs is more the
weaker the curvature is that the rows leave."""

_ROUNDINGS = 4.0
"""Of the forces at a variable, times eps: how hard it may still be pulled to where it may go."""

_FEW = 4
"""Lanes that are searched together on a CPU."""

Propose = Callable[[QP, Array, Array, int], Proposal]


@cache
def searcher(max_iterations: int, gives_way: bool, backend: Backend) -> Callable[[QP, Array, Array], Found]:
    """The search for one problem, with a cap on the changes of the active set.

    Args:
        max_iterations: the cap.
        gives_way: whether rows may give way; where all are hard, Warp's kernel is not asked.
        backend: whose candidates are taken.
    """
    return in_lanes(partial(_search_anywhere, cap=max_iterations, gives_way=gives_way, backend=backend))


def _search_anywhere(qp: QP, guess: Array, tolerance: Array, *, cap: int, gives_way: bool, backend: Backend) -> Found:
    whole = partial(search, max_iterations=cap)
    on_gpu = partial(proposed_and_searched, propose=_kernel.propose, max_iterations=cap)
    kernels = {"warp": on_gpu} if takes(backend, "warp", fits=gives_way and _fits(qp)) else {}
    if not takes(backend, "numba", fits=isinstance(qp.cost, LeastSquares)):
        return on_platforms(kernels, whole, qp, guess, tolerance)
    holds = CERTIFIED[tolerance.dtype]
    candidates = in_double(partial(certified_candidates, propose=_cpu_kernel.propose, max_iterations=cap, holds=holds))
    left = partial(search_what_is_left, max_iterations=cap)
    if kernels or jax.default_backend() != "cpu":

        def on_cpu(qp: QP, guess: Array, tolerance: Array) -> Found:
            return left(qp, tolerance, candidates(qp, guess, tolerance))

        return on_platforms(kernels | {"numba": on_cpu}, whole, qp, guess, tolerance)
    # the search is traced once for all platforms, and on those without the kernel nothing is found before it
    return left(qp, tolerance, on_platforms({"numba": candidates}, unsearched, qp, guess, tolerance))


def system_solver(qp: QP, active: Int[Array, " m"], backend: Backend) -> Callable[[Array], Array]:
    """The inverse of the optimality conditions at an active set, as ``system_inverse``, by the kernel where it can."""
    lanes = jax.tree.map(lambda a: jax.ShapeDtypeStruct((1, *a.shape), a.dtype), qp)
    if not takes(backend, "warp", fits=_fits(lanes)):
        return system_inverse(qp, active)
    return lambda right: _solve_anywhere()(qp, active, right)


@cache
def _solve_anywhere() -> Callable[[QP, Array, Array], Array]:
    def plain(qp: QP, active: Array, right: Array) -> Array:
        return system_inverse(qp, active)(right)

    return in_lanes(partial(on_platforms, {"warp": _solved_by_kernel}, jax.vmap(plain)))


def _solved_by_kernel(qp: QP, active: Int[Array, "B m"], right: Float[Array, "B m"]) -> Float[Array, "B m"]:
    """The system as a QP of one active set: what is held is pinned, what is free has no bounds."""
    cost = qp.cost
    assert isinstance(cost, LeastSquares)
    n = cost.damping.shape[1]
    free, held = active[:, :n] == INACTIVE, active[:, n:] != INACTIVE
    center = jnp.where(free, right[:, :n], 0.0) / cost.damping
    at = jnp.concatenate([jnp.zeros_like(center), -right[:, n:]], 1)
    pinned = jnp.concatenate([~free, held], 1)
    system = replace(
        qp,
        cost=replace(cost, target=jnp.zeros_like(cost.target), center=center),
        lower=jnp.where(pinned, at, -jnp.inf),
        upper=jnp.where(pinned, at, jnp.inf),
    )
    tolerance = jnp.full(len(active), _TIGHTEST, center.dtype)
    found = _kernel.propose(system, jnp.where(pinned, EQUALITY, INACTIVE), tolerance, 0)
    point = jnp.concatenate([found.x, jnp.where(held, found.row_multipliers, 0.0)], 1)
    done = (found.settled != 0) & jnp.isfinite(point).all(1)

    def again(at: Array, point: Array) -> Array:
        part = jax.tree.map(lambda a: a[at], (qp, active, right))
        return jax.vmap(lambda qp, active, right: system_inverse(qp, active)(right))(*part)

    return with_the_rest(point, done, again, _block(len(active)))


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
    start, single = jax.vmap(possible)(qp, guess), jnp.maximum(tolerance, _SINGLE)
    proposal = propose(qp, start, single, max_iterations)
    found = _found(qp, proposal)
    fine = (proposal.settled != 0) & (proposal.iterations <= max_iterations)
    fine &= jax.vmap(_certified)(qp, found, single) & (found.residual <= CERTIFIED[single.dtype])
    found = found._replace(done=fine, optimal=fine)

    def again(at: Array, found: Found) -> Found:
        part = jax.tree.map(lambda a: a[at], (qp, found.active, tolerance))
        end = search(*part, max_iterations=max_iterations)
        return end._replace(factorizations=end.factorizations + found.factorizations[at])

    return with_the_rest(found, fine, again, _block(len(tolerance)))


def certified_candidates(
    qp: QP,
    guess: Int[Array, "B m"],
    tolerance: Float[Array, " B"],
    *,
    propose: Propose,
    max_iterations: int,
    holds: float,
) -> Found:
    """Proposals, done where they are certified: by a residual of ``holds`` at most, and a slope not told from none."""
    start = jax.vmap(possible)(qp, guess)
    proposal = propose(qp, start, tolerance, max_iterations)
    found, within = _found(qp, proposal), proposal.iterations <= max_iterations
    fine = (proposal.settled != 0) & within
    fine &= jax.vmap(_certified)(qp, found, tolerance) & jax.vmap(_rests)(qp, found)
    fine &= found.residual <= holds
    # the search has the cap too: it may not begin where more changes than that have led
    return found._replace(done=fine, optimal=fine, active=jnp.where(within[:, None], found.active, start))


def search_what_is_left(qp: QP, tolerance: Float[Array, " B"], found: Found, *, max_iterations: int) -> Found:
    """The search, a few lanes at a time, in those that are not done; it goes on from their active sets."""

    def again(given: tuple[QP, Array], found: Found) -> Found:
        end = search(given[0], found.active, given[1], max_iterations=max_iterations)
        return end._replace(factorizations=end.factorizations + found.factorizations)

    return with_a_few((qp, tolerance), found, found.done, again, _FEW)


def _rests(qp: QP, found: Found) -> Bool[Array, ""]:
    """Whether no variable is pulled to where it may go by more than rounding of the forces at it."""
    pull = apply(qp.rows.T, found.row_multipliers) - qp.cost.gradient(found.x)
    active = found.active[: len(pull)]
    up, down = (active == INACTIVE) | (active == -1), (active == INACTIVE) | (active == 1)
    rounding = _ROUNDINGS * float(jnp.finfo(pull.dtype).eps) * forces(qp, found.x, found.row_multipliers)
    return jnp.all((~up | (pull <= rounding)) & (~down | (-pull <= rounding)))


def _block(lanes: int) -> int:
    return min(lanes, max(_SMALLEST, -(-lanes // _SHARE)))


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
        descended=nothing.astype(bool),
        infeasible=nothing.astype(bool),
        compliance=qp.compliance,
        residual=jax.vmap(kkt_residual)(qp, proposal.x, proposal.row_multipliers, proposal.active),
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
