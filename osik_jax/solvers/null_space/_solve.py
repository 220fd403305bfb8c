"""Entry point of null-space projection: check the data, choose the method, set the status."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..._errors import OsikValueError
from ...execution._backends import Backend, check_backend
from ...numerics._constants import NULL_SPACE_RANK
from .._box import clip_to_box, ordered_bounds
from .._damping import Damping, per_level
from .._level import are_finite, bounds_exist
from .._status import Status
from ..hqp import Level
from ._padding import NullSpaceSolution
from ._projection import project
from ._saturation import BoundedAnswer, solve_saturated


@partial(jax.jit, static_argnames=("max_iterations", "backend"))
def solve_nullspace(
    levels: Sequence[Level],
    lower: Float[ArrayLike, " n"] | None = None,
    upper: Float[ArrayLike, " n"] | None = None,
    *,
    secondary: Float[Array, " n"] | None = None,
    damping: Float[Array, ""] | float | Damping | Sequence[Float[Array, ""] | Damping] = 0.0,
    rank_tolerance: Float[Array, ""] | float | None = None,
    max_iterations: int | None = None,
    backend: Backend = "auto",
) -> NullSpaceSolution:
    """Solve each level as nearly as the null space of the levels above it allows.

    Pure, compiled on first use, batched by ``vmap``, differentiable in both modes: at constant rank, and with bounds at
    the saturated joints. Two methods:

    - no bounds: the classical projection, from the highest level down (eqs. 6 and 7).
    - bounds: saturation in the null space (Flacco, De Luca, Khatib 2012, 2015). Joints that would leave their bounds
      are saturated and the others take over; a level for which that does not suffice is scaled down, by the largest
      scale that fits.

    Args:
        levels: highest priority first. A row with lower < upper counts only where the levels above violate it.
        lower: hard bounds on x, -inf where unbounded; equal to ``upper`` for joints that cannot be moved. (n,)
        upper: hard bounds on x, inf where unbounded. (n,)
        secondary: motion in what all levels leave free, such as a potential's descent; with bounds, x comes as near to
            it as levels and bounds allow. (n,)
        damping: of the motion of each level, in squared singular values: s / (s^2 + damping) stands for 1 / s. One for
            all, or a list with one for each level. A ``Damping`` has a part that vanishes where the level can be met.
        rank_tolerance: rows of A P that stand out of the span of the longer ones by less than this share of the
            Frobenius norm of A count as dependent on them (P projects onto what the levels before leave free);
            default 1e-10 (1e-5 in float32). Against A and not A P, so that a level which repeats one above it has
            rank 0, not the rank of its rounding.
        max_iterations: limit on the search for the saturated joints, for each level (static); default 10 (n + 2).
        backend: whose kernels compute (static): "auto" for those that are there for the platform, "jax" for none,
            "core" for those or an error. It changes the time, not the answer.

    Raises:
        ValueError: a wrong shape, or a damping too many or few.
    """
    backend = check_backend(backend)
    n = levels[0].matrix.shape[1]
    dtype = jnp.result_type(*(level.matrix for level in levels))
    box = _bounds(lower, upper, n, dtype)
    # without a secondary motion x is the smallest: the motion towards 0
    motion = jnp.zeros(n, dtype) if secondary is None else jnp.asarray(secondary, dtype)
    # bounds with lower > upper become equalities halfway; the status says so
    levels, unordered = zip(*(level.ordered() for level in levels), strict=True)
    bounds_are_ordered = ~jnp.stack(unordered).any()
    dampings = per_level(damping, len(levels), n, dtype)
    # where the data are not finite, a placeholder of zeros is solved, in a box of ones
    numbers = [jnp.isfinite(a).all() for a in (motion, *dampings)]
    is_valid = jnp.stack([*are_finite(levels), *numbers, *([] if box is None else [bounds_exist(*box)])]).all()
    valid, motion, dampings = jax.tree.map(
        lambda leaf: jnp.where(is_valid, leaf, 0.0), (list(levels), motion, dampings)
    )
    scaled = [level.scaled() for level in valid]
    rank_tol = NULL_SPACE_RANK[dtype] if rank_tolerance is None else rank_tolerance
    if box is None:
        x, projector = project(scaled, motion, dampings, rank_tol, backend)
        scales, inactive = jnp.ones(len(levels), dtype), jnp.zeros(n, jnp.int32)
        answer = BoundedAnswer(x, projector, scales, inactive, jnp.asarray(0), jnp.asarray(True))
        return _solution(valid, answer, is_valid, bounds_are_ordered, jnp.zeros(n, dtype))
    limit = 10 * (n + 2) if max_iterations is None else max_iterations
    low, high, empty = ordered_bounds(*box)
    safe = jnp.where(is_valid, low, -1.0), jnp.where(is_valid, high, 1.0)
    target = None if secondary is None else motion
    answer = solve_saturated(scaled, *safe, target, dampings, rank_tol, limit, backend)
    return _solution(valid, answer, is_valid, bounds_are_ordered & ~empty, clip_to_box(jnp.zeros(n, dtype), *box))


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


def _solution(
    levels: Sequence[Level], answer: BoundedAnswer, is_valid: Array, bounds_are_ordered: Array, fallback: Array
) -> NullSpaceSolution:
    """Return the answer with its status and finite numbers; ``fallback`` if the data are not valid."""
    is_valid &= jnp.isfinite(answer.x).all()
    x = jnp.where(is_valid, answer.x, fallback)
    status = jnp.where(answer.done, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(bounds_are_ordered, status, Status.INFEASIBLE)
    return NullSpaceSolution(
        x=x,
        slacks=tuple(jnp.where(is_valid, level.distance(x), 0.0) for level in levels),
        status=jnp.where(is_valid, status, Status.NUMERICAL_ERROR),
        projector=answer.projector,
        scales=answer.scales,
        active=answer.active,
        iterations=answer.iterations,
    )
