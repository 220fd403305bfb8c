"""solve_hqp: descend level after level, differentiate nothing but the answer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ... import _rules
from .._backends import Backend, check_backend, here
from .._box import inside, uncrossed
from .._damping import Damping, one_each
from .._level import Level
from .._status import Status
from ._cascade import NOTHING, Descent
from ._fused import descender
from ._problem import HQPSolution, Tolerances, WorkingSet
from ._replay import with_derivative
from ._stack import stacked

_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-6}
"""Rounding of the data makes rows independent that are not."""


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
    """Lexicographic least squares: level k minimises |w_k|^2 among the minimisers of the levels before it.

    w_k is the (weighted) distance of the level's rows A_k x to their intervals [lower_k, upper_k]; the box
    ``lower <= x <= upper`` is hard at every level. What freedom is left after the last level goes into the smallest
    |x|, so that the answer is unique. Pure, compiled on first use, and batched by ``vmap``.

    Each level tries the working set of the warm start, then one that a dual method proposes, and judges the exact
    solution on it by its multipliers; where neither is the optimum, a primal active set goes on by hand. A row
    violated at its optimum, and every hard row with a nonzero multiplier, is tight on the whole face of minimisers: it
    is frozen as an equality before the next level and eliminated by its null space. The search is in double precision
    also where the data are single.

    Args:
        levels: highest priority first; any number, each an equality or inequality level or a mixture.
        lower: box, -inf where unbounded. (n,)
        upper: box, inf where unbounded. (n,)
        damping: of each level, or one for all: the level minimises ``1/2 |w_k|^2 + 1/2 damping |x|^2``, and the levels
            below it keep what its rows have reached, A_k x. >= 0. A ``Damping`` has a part that vanishes where the
            level can be met.
        warm_start: that of the solution of a problem nearby with the same levels. It changes the time, not the answer.
        max_iterations: cap on the active-set iterations of one level (static); default 10 (n + rows of the level).
        tolerances: what counts as zero; the default rank tolerance depends on the precision of the data.
        backend: whose candidates for the answer are taken (static): "auto" for those of the kernels that are there for
            the platform, "jax" for none, "numba" (CPUs) or "warp" (CUDA) for those or an error. It changes the time,
            not the answer.

    Returns:
        The solution; never raises inside jit. x satisfies its box exactly, whatever the status.

    When not to use it: one level (``solve_least_squares_qp`` is several times faster).
    """
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    dtype = jnp.result_type(lower, *(level.matrix for level in levels))
    tolerances = Tolerances(rank=_RANK[dtype]) if tolerances is None else tolerances
    damped = one_each(damping, len(levels), len(lower), dtype)
    sane = _finite(levels, lower, upper) & jnp.stack([(jnp.isfinite(a) & (a >= 0.0)).all() for a in damped]).all()
    equal = [level.equal | ~sane for level in levels]
    levels, crossed = zip(*(level.uncrossed() for level in levels), strict=True) if levels else ((), ())
    low, high, empty = uncrossed(lower, upper)
    possible = ~jnp.stack([empty, *crossed]).any()
    low, high = (jnp.where(sane, b, side).astype(dtype) for b, side in ((low, -1.0), (high, 1.0)))
    scaled = [jax.tree.map(lambda leaf: jnp.where(sane, leaf, 0.0), level.scaled()) for level in levels]
    scaled, equal = [*scaled, _no_rows(len(low), dtype)], [*equal, jnp.ones(0, bool)]
    # the last level has nothing but damping: the smallest norm
    damped = Damping(
        *(_with_last(jnp.where(sane, a, 0.0), last) for a, last in zip(damped, (1.0, 0.0, 0.0, 0.0), strict=True))
    )
    layout, stack = stacked(scaled, equal, low, high, (lower >= upper) & sane, damped)
    traced = jax.tree.map(lambda a: jnp.asarray(a, dtype), tolerances)
    search = descender(layout, max_iterations, here(check_backend(backend)))
    end = _rules.found(search(*jax.lax.stop_gradient((stack, traced, warm_start))))
    nothing = jnp.maximum(NOTHING * traced.rank, 100.0 * jnp.finfo(dtype).eps)
    x = with_derivative(end.x, end.decisions, stack, nothing)
    return _answer(levels, end, x, sane, possible, lower, upper)


def _with_last(a: Array, last: float) -> Array:
    return jnp.concatenate([a, jnp.full_like(a[:1], last)])


def _no_rows(n: int, dtype: jnp.dtype) -> Level:
    return Level(jnp.zeros((0, n), dtype), jnp.zeros(0, dtype))


def _finite(levels: Sequence[Level], lower: Array, upper: Array) -> Bool[Array, ""]:
    """Whether the numbers can be computed with: no NaN, no infinity but as no bound."""
    checks = [jnp.isfinite(level.matrix).all() for level in levels]
    checks += [(low < jnp.inf).all() & (high > -jnp.inf).all() for low, high in _bounds(levels, lower, upper)]
    checks += [jnp.isfinite(level.weight).all() for level in levels if level.weight is not None]
    return jnp.stack(checks).all()


def _bounds(levels: Sequence[Level], lower: Array, upper: Array) -> list[tuple[Array, Array]]:
    return [(lower, upper), *((level.lower, level.upper) for level in levels)]


def _answer(
    levels: Sequence[Level],
    end: Descent,
    x: Array,
    sane: Array,
    possible: Array,
    lower: Array,
    upper: Array,
) -> HQPSolution:
    at_bound = jnp.where(end.box < 0, lower, jnp.where(end.box > 0, upper, x))
    good = sane & jnp.isfinite(x).all()
    x = inside(jnp.where(good, at_bound, 0.0), lower, upper)
    status = jnp.where(end.done, Status.SOLVED, Status.MAX_ITERATIONS)
    status = jnp.where(possible, status, Status.INFEASIBLE)
    return HQPSolution(
        x=x,
        slacks=tuple(jnp.where(good, level.distance(x), 0.0) for level in levels),
        status=jnp.where(good, status, Status.NUMERICAL_ERROR),
        iterations=end.iterations,
        factorizations=end.factorizations,
        kkt_residual=jnp.where(good, end.residual, jnp.inf),
        active=end.box,
        active_rows=tuple(end.working.own[k, : len(level.lower)] for k, level in enumerate(levels)),
        multipliers=jnp.where(good, end.multipliers[:-1], 0.0),
        warm_start=end.working,
    )
