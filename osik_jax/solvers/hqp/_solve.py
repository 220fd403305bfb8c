"""Entry point of hierarchies: check and pad the data, solve, attach the derivative, set the status."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ...execution import _rules
from ...execution._backends import Backend, check_backend
from ...numerics._constants import HIERARCHY_RANK, SINGULAR_TOL, ZERO_PIVOT
from .._box import clip_roundoff, ordered_bounds
from .._damping import Damping, per_level
from .._level import Level, are_finite, bounds_exist
from .._status import Status
from ._cascade import CascadeResult
from ._dispatch import hierarchy_solver
from ._implicit_diff import with_derivative
from ._problem import HQPSolution, Tolerances, WorkingSet, pad_hierarchy


@partial(jax.jit, static_argnames=("max_iterations", "backend"))
def solve_hqp(
    levels: Sequence[Level],
    lower: Float[ArrayLike, " n"],
    upper: Float[ArrayLike, " n"],
    *,
    damping: Float[ArrayLike, ""] | Damping | Sequence[Float[ArrayLike, ""] | Damping] = 0.0,
    warm_start: WorkingSet | None = None,
    max_iterations: int | None = None,
    tolerances: Tolerances | None = None,
    backend: Backend = "auto",
) -> HQPSolution:
    """Solve lexicographic least squares: level k minimises |w_k|^2 among the minimisers of the levels before it.

    w_k is the (weighted) distance of the level's rows A_k x to their intervals [lower_k, upper_k]; the box
    ``lower <= x <= upper`` is hard at every level. What freedom is left after the last level goes into the smallest
    |x|, so that the answer is unique. Pure, compiled on first use, and batched by ``vmap``.

    Each level is solved on the working set of the warm start, and the exact solution is judged by its multipliers;
    where it is not the optimum, without a warm start, or without a kernel, a primal active-set method goes on. A row
    violated at its optimum, and every hard row with a nonzero multiplier, has one value on the whole face of
    minimisers: it is frozen as an equality before the next level and eliminated by its null space. The search is in
    double precision also where the data are single.

    Args:
        levels: highest priority first; any number, each an equality or inequality level or a mixture.
        lower: box, -inf where unbounded. (n,)
        upper: box, inf where unbounded. (n,)
        damping: of each level, or one for all: the level minimises ``1/2 |w_k|^2 + 1/2 damping |x|^2``, and the levels
            below it keep what its rows have reached, A_k x. >= 0. A ``Damping`` has a part that vanishes where the
            level can be met.
        warm_start: that of the solution of a problem nearby with the same levels. It changes the time, not the answer;
            plain JAX ignores it.
        max_iterations: limit on the active-set iterations of one level (static); default 10 (n + rows of the level).
        tolerances: what counts as zero; the default rank tolerance depends on the precision of the data.
        backend: whose candidates for the answer are taken (static): "auto" for those of the kernels that are there for
            the platform, "jax" for none, "core" for those or an error. It changes the time, not the answer.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.

    When not to use it: of one level, for which ``solve_least_squares_qp`` has less to do.
    """
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    dtype = jnp.result_type(lower, *(level.matrix for level in levels))
    tolerances = Tolerances(rank=HIERARCHY_RANK[dtype]) if tolerances is None else tolerances
    dampings = per_level(damping, len(levels), len(lower), dtype)
    damping_is_valid = jnp.stack([(jnp.isfinite(a) & (a >= 0.0)).all() for a in dampings]).all()
    is_finite = jnp.stack([*are_finite(levels), bounds_exist(lower, upper), damping_is_valid]).all()
    # where the data are not finite, a placeholder is solved: equalities of zeros in a box of ones
    equal = [level.equal | ~is_finite for level in levels]
    levels, unordered = zip(*(level.ordered() for level in levels), strict=True) if levels else ((), ())
    low, high, box_unordered = ordered_bounds(lower, upper)
    bounds_are_ordered = ~jnp.stack([box_unordered, *unordered]).any()
    low, high = (jnp.where(is_finite, b, one).astype(dtype) for b, one in ((low, -1.0), (high, 1.0)))
    scaled = [jax.tree.map(lambda leaf: jnp.where(is_finite, leaf, 0.0), level.scaled()) for level in levels]
    # a last level without rows and with a damping of 1 minimises |x|^2
    scaled, equal = [*scaled, _no_rows(len(low), dtype)], [*equal, jnp.ones(0, bool)]
    smallest_norm = (1.0, 0.0, 0.0, 0.0)
    dampings = Damping(
        *(_append(jnp.where(is_finite, a, 0.0), last) for a, last in zip(dampings, smallest_norm, strict=True))
    )
    layout, hierarchy = pad_hierarchy(scaled, equal, low, high, (lower >= upper) & is_finite, dampings)
    traced = jax.tree.map(lambda a: jnp.asarray(a, dtype), tolerances)
    solve = hierarchy_solver(layout, max_iterations, check_backend(backend))
    result = _rules.found(solve(*jax.lax.stop_gradient((hierarchy, traced, warm_start))))
    # the derivative is computed in the precision of the data: no singular value below its roundoff is inverted
    singular_tol = jnp.maximum(ZERO_PIVOT * traced.rank, SINGULAR_TOL * jnp.finfo(dtype).eps)
    x = with_derivative(result.x, result.active_sets, hierarchy, singular_tol, backend)
    return _solution(levels, result, x, is_finite, bounds_are_ordered, lower, upper)


def _append(a: Array, last: float) -> Array:
    return jnp.concatenate([a, jnp.full_like(a[:1], last)])


def _no_rows(n: int, dtype: jnp.dtype) -> Level:
    return Level(jnp.zeros((0, n), dtype), jnp.zeros(0, dtype))


def _solution(
    levels: Sequence[Level],
    result: CascadeResult,
    x: Float[Array, " n"],
    is_finite: Bool[Array, ""],
    bounds_are_ordered: Bool[Array, ""],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> HQPSolution:
    """Return the answer with its status: x exactly inside its box, all numbers finite.

    x is the result's, with its derivative. ``is_finite`` says whether the data can be computed with,
    ``bounds_are_ordered`` whether no lower bound of the data is above its upper bound.
    """
    # at an active bound x is that bound, to the last bit and with its derivative
    at_bound = jnp.where(result.active_bounds < 0, lower, jnp.where(result.active_bounds > 0, upper, x))
    is_valid = is_finite & jnp.isfinite(x).all()
    x = clip_roundoff(jnp.where(is_valid, at_bound, 0.0), lower, upper)
    status = jnp.where(result.done, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(bounds_are_ordered, status, Status.INFEASIBLE)
    return HQPSolution(
        x=x,
        slacks=tuple(jnp.where(is_valid, level.distance(x), 0.0) for level in levels),
        status=jnp.where(is_valid, status, Status.NUMERICAL_ERROR),
        iterations=result.iterations,
        factorizations=result.factorizations,
        kkt_residual=jnp.where(is_valid, result.residual, jnp.inf),
        active=result.active_bounds,
        active_rows=tuple(result.working_sets.own[k, : len(level.lower)] for k, level in enumerate(levels)),
        multipliers=jnp.where(is_valid, result.multipliers[:-1], 0.0),
        warm_start=result.working_sets,
    )
