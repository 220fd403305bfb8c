"""solve_nullspace: which method, inputs that can be computed with, and the answer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ..._errors import OsikValueError
from .._backends import Backend, check_backend, here, takes
from .._box import clip_to_box, uncrossed
from .._damping import Damping, one_each
from .._status import Status
from ..hqp import Level
from ._fused import project
from ._problem import RANK, NullSpaceSolution, sane
from ._reverse import solve_reverse
from ._saturation import Saturated, solve_saturated

ORDERS = ("forward", "reverse")


@partial(jax.jit, static_argnames=("order", "max_iterations", "backend"))
def solve_nullspace(
    levels: Sequence[Level],
    lower: Float[ArrayLike, " n"] | None = None,
    upper: Float[ArrayLike, " n"] | None = None,
    *,
    order: Literal["forward", "reverse"] = "forward",
    secondary: Float[Array, " n"] | None = None,
    damping: Float[Array, ""] | float | Damping | Sequence[Float[Array, ""] | Damping] = 0.0,
    rank_tolerance: Float[Array, ""] | float | None = None,
    max_iterations: int | None = None,
    backend: Backend = "auto",
) -> NullSpaceSolution:
    """Each level as nearly as the null space of the levels above it allows.

    Pure, compiled on first use, batched by ``vmap``, differentiable in both modes: at constant rank, and with bounds at
    the saturated joints. Three methods:

    - no bounds, ``order="forward"``: the classical projection, from the highest level down (eqs. 6 and 7).
    - no bounds, ``order="reverse"``: from the lowest level up, the highest last (Flacco, De Luca 2014). Both orders
      give the same answer where all levels can be met together. Where they cannot, the highest level is as exact as if
      it were alone in both; the reverse order has no jump where a level comes to depend on those above.
    - bounds: saturation in the null space (Flacco, De Luca, Khatib 2012, 2015). Joints that would leave their bounds
      are put on them and the others take over; a level for which that does not suffice is scaled down, by the largest
      scale that fits.

    Args:
        levels: highest priority first. A row with lower < upper counts only where it is violated by what came before
            it: the levels above, in reverse order those below and the secondary motion.
        lower: hard bounds on x, -inf where unbounded; equal to ``upper`` for joints that cannot be moved. (n,)
        upper: hard bounds on x, inf where unbounded. (n,)
        order: of the levels (static).
        secondary: motion in what all levels leave free, such as a potential's descent; with bounds, x comes as near to
            it as levels and bounds allow. (n,)
        damping: of the motion of each level, in squared singular values: s / (s^2 + damping) stands for 1 / s. One for
            all, or a list with one for each level. A ``Damping`` has a part that vanishes where the level can be met;
            in the reverse order all of it counts.
        rank_tolerance: rows of A P that stand out of the span of the longer ones by less than this share of the
            Frobenius norm of A count as dependent on them (P projects onto what the levels before leave free);
            default 1e-10 (1e-5 in float32). Against A and not A P, so that a level which repeats one above it has
            rank 0, not the rank of its rounding.
        max_iterations: cap on the search for the saturated joints, for each level (static); default 10 (n + 2).
        backend: whose kernels compute (static): "auto" for those that are there for the platform, "jax" for none,
            "numba" (CPUs) for those or an error. It changes the time, not the answer.

    Raises:
        ValueError: an order that does not exist, bounds in reverse order, a damping too many or few, or a backend that
            has no kernels for this.
    """
    backend = here(check_backend(backend))
    takes(backend, "warp", fits=False)
    n = levels[0].matrix.shape[1]
    dtype = jnp.result_type(*(level.matrix for level in levels))
    box = _bounds(lower, upper, n, dtype)
    if order not in ORDERS:
        raise OsikValueError(f"order is {order!r}; orders: {', '.join(ORDERS)}")
    if box is not None and order == "reverse":
        raise OsikValueError("bounds need order='forward': saturation goes from the highest level down")
    pull = jnp.zeros(n, dtype) if secondary is None else jnp.asarray(secondary, dtype)
    levels, crossed = zip(*(level.uncrossed() for level in levels), strict=True)
    possible = ~jnp.stack(crossed).any()
    given = one_each(damping, len(levels), n, dtype)
    good = sane(levels, pull, *given) & (True if box is None else _exists(*box))
    clean, pull, given = _where(good, (list(levels), pull, given))
    damped = [Damping(*parts) for parts in zip(*given, strict=True)]
    scaled = [level.scaled() for level in clean]
    rank = RANK[dtype] if rank_tolerance is None else rank_tolerance
    if box is None:
        if order == "forward":
            answer = _free(*project(scaled, pull, given, rank, backend), count=len(levels))
        else:
            answer = _free(*solve_reverse(scaled, pull, damped, rank, backend), count=len(levels))
        return _solution(clean, answer, good, possible, jnp.zeros(n, dtype))
    cap = 10 * (n + 2) if max_iterations is None else max_iterations
    low, high, empty = uncrossed(*box)
    safe = jnp.where(good, low, -1.0), jnp.where(good, high, 1.0)
    answer = solve_saturated(scaled, *safe, None if secondary is None else pull, damped, rank, cap, backend)
    return _solution(clean, answer, good, possible & ~empty, clip_to_box(jnp.zeros(n, dtype), *box))


def _where(good: Array, tree: Any) -> Any:
    """The numbers as they are, or zeros."""
    return jax.tree.map(lambda leaf: jnp.where(good, leaf, 0.0), tree)


def _bounds(lower: Any, upper: Any, n: int, dtype: Any) -> tuple[Array, Array] | None:
    if lower is None and upper is None:
        return None
    low, high = (
        jnp.full(n, none, dtype) if bound is None else jnp.asarray(bound, dtype)
        for bound, none in ((lower, -jnp.inf), (upper, jnp.inf))
    )
    for name, bound in (("lower", low), ("upper", high)):
        if bound.shape != (n,):
            raise OsikValueError(f"{name} has shape {bound.shape}; the levels ask for {(n,)}")
    return low, high


def _exists(lower: Float[Array, " n"], upper: Float[Array, " n"]) -> Bool[Array, ""]:
    return ((lower < jnp.inf) & (upper > -jnp.inf)).all()


def _free(x: Float[Array, " n"], projector: Float[Array, "n n"], *, count: int) -> Saturated:
    """Answer without bounds."""
    nothing = jnp.zeros(len(x), jnp.int32)
    return Saturated(x, projector, jnp.ones(count, x.dtype), nothing, jnp.asarray(0), jnp.asarray(True))


def _solution(
    levels: Sequence[Level], answer: Saturated, good: Array, possible: Array, fallback: Array
) -> NullSpaceSolution:
    good &= jnp.isfinite(answer.x).all()
    x = jnp.where(good, answer.x, fallback)
    status = jnp.where(answer.done, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(possible, status, Status.INFEASIBLE)
    return NullSpaceSolution(
        x=x,
        slacks=tuple(jnp.where(good, level.distance(x), 0.0) for level in levels),
        status=jnp.where(good, status, Status.NUMERICAL_ERROR),
        projector=answer.projector,
        scales=answer.scales,
        active=answer.active,
        iterations=answer.iterations,
    )
