"""Damping of a level: a constant, plus a part in proportion to the error that the level's linear model cannot meet.

A linear model is wrong by ``1/2 dt^2 (grad^2 e)[v, v]``, and what that costs is its product with the residual that the
model leaves. Where a step meets the level's demand there is no residual, so nothing has to be damped; where the demand
is out of reach, all of it is left. So the second part is ``unmet ratio`` with ``ratio = |residual| / |demand|``, and
the residual is that of the damped step itself: a fixed point, found from ratio 1 downwards. In one dimension the
damping is ``max(0, unmet - s^2)`` for a singular value s: a threshold on singular values, without an SVD
(docs/dev/derivations.md, "Curvature damping").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..numerics._constants import (
    BLOCKING_PART,
    COST_FRACTION,
    DAMPING_ITERATIONS,
    DAMPING_RIDGE,
    DAMPING_RIDGE_ROUNDOFF,
    MIN_RADIUS,
    NEGLIGIBLE_CURVATURE,
    NEGLIGIBLE_DAMPING,
    TIE_ROUNDOFF,
)
from ..numerics._dense import apply, product
from ..numerics._guarded import clipped, positive_root, quotient, safe_norm
from ._level import Level, PaddedLevel


class Damping(NamedTuple):
    """Damping of one level, which minimises ``1/2 |w|^2 + 1/2 (constant + unmet ratio) |x|^2``.

    ``ratio`` is the size of the residual w that the level's own step, clipped into the box, leaves, relative to
    ``demand``; it is 1 at most.

    ``bends`` is the curvature of the level's rows along each variable alone, for a unit residual: a bound on the row
    sums of their second derivative, times dt. Where the level is out of reach, those below it get a narrower box
    (``narrow_box``).
    """

    constant: Any = 0.0  # Float[Array, ""], and so the following
    unmet: Any = 0.0
    demand: Any = 0.0
    bends: Any = 0.0  # Float[Array, " n"]


def per_level(damping: Any, count: int, n: int, dtype: Any) -> Damping:
    """Return the dampings of ``count`` levels of n variables as one object with a leading axis of levels.

    ``damping`` is a number or a ``Damping`` for all levels, or a sequence with one for each.
    """
    single = isinstance(damping, Damping) or not isinstance(damping, Sequence)
    given = [damping] * count if single else list(damping)
    if len(given) != count:
        raise OsikValueError(f"there are {len(given)} dampings and {count} levels")
    dampings = [one if isinstance(one, Damping) else Damping(one) for one in given]
    constant, unmet, demand, bends = (
        jnp.array([jnp.asarray(part, dtype) for part in parts], dtype) for parts in _fields(dampings)
    )
    return Damping(constant, unmet, demand, jnp.broadcast_to(bends if bends.ndim == 2 else bends[:, None], (count, n)))


def _fields(dampings: Sequence[Damping]) -> list[list]:
    fields = [[getattr(one, name) for one in dampings] for name in Damping._fields]
    return [*fields[:-1], jnp.broadcast_arrays(*fields[-1])]


def level_damping(
    damping: Damping,
    level: Level | PaddedLevel,
    x: Float[Array, " n"],
    projector: Float[Array, "n n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    above: HardRows | None = None,
) -> Float[Array, ""]:
    """Return the damping of one level, ``constant + unmet * ratio``; 0 if the ratio's gradient would be roundoff.

    ``unmet`` and ``demand`` are fields of ``damping``. The ratio is what the damped step leaves of the level's error,
    over ``demand``, and at most 1. As the step depends on the damping, it is a fixed point, found from 1 downwards.
    Weights are multiplied into the level; x is where the levels above have ended, and the projector is onto what they
    leave free. The step may not violate the rows ``above``.
    """
    # the level's step does not depend on what x has in the projector's range
    base = x - apply(projector, x)
    goal = -level.distance(base)
    # where a row stands on its bound, roundoff must not decide whether the step has to keep it there
    terms = jnp.sqrt(jnp.sum(level.matrix**2, -1)) * jnp.max(jnp.abs(x), initial=0.0)
    in_cost = level.equal | (jnp.abs(goal) > TIE_ROUNDOFF * float(jnp.finfo(goal.dtype).eps) * terms)
    goal = jnp.where(in_cost, goal, 0.0)
    rows = jnp.where(in_cost[:, None], product(level.matrix, projector), 0.0)
    gram = product(rows, rows.T)
    eye = jnp.eye(len(goal), dtype=gram.dtype)
    ridge = max(DAMPING_RIDGE, DAMPING_RIDGE_ROUNDOFF * float(jnp.finfo(gram.dtype).eps)) * jnp.trace(gram)
    demand = jnp.where(damping.demand > 0.0, damping.demand, 1.0)
    ratio = jnp.ones_like(damping.unmet)
    blocking = None if above is None or not len(above.matrix) else _blocking(above, projector)
    for _ in range(DAMPING_ITERATIONS):
        # the damped step J'(J J' + damping I)^-1 goal, clipped into the box
        total = damping.constant + damping.unmet * ratio + ridge
        factor = jnp.linalg.cholesky(gram + jnp.where(total > 0.0, total, 1.0) * eye)
        end = base + apply(rows.T, cho_solve((factor, True), goal))
        # without the rows above, a level that they stop would count as met, and nothing would bound its step
        end = clipped(end if blocking is None else _kept_inside(end, blocking), lower, upper)
        residual = safe_norm(level.distance(end))
        ratio = jnp.minimum(quotient(residual, demand), 1.0)
    total = damping.constant + damping.unmet * ratio
    longest_square = jnp.max(jnp.sum(level.matrix**2, -1), initial=0.0)
    return jnp.where(total > NEGLIGIBLE_DAMPING * longest_square, total, 0.0)


class HardRows(NamedTuple):
    """Rows ``lower <= matrix x <= upper`` of the levels above; unused rows have infinite bounds."""

    matrix: Float[Array, "r n"]
    lower: Float[Array, " r"]
    upper: Float[Array, " r"]


class _Blocking(NamedTuple):
    """Rows of the levels above, each with the direction in the projector's range that changes it at rate 1."""

    rows: HardRows
    direction: Float[Array, "r n"]


def _blocking(above: HardRows, projector: Float[Array, "n n"]) -> _Blocking:
    inside = product(above.matrix, projector)
    square = jnp.sum(inside**2, -1)
    # a row that depends on the frozen rows does not move
    moves = square > BLOCKING_PART**2 * jnp.sum(above.matrix**2, -1)
    return _Blocking(above, jnp.where(moves[:, None], inside / jnp.where(moves, square, 1.0)[:, None], 0.0))


def _kept_inside(x: Float[Array, " n"], blocking: _Blocking) -> Float[Array, " n"]:
    """Return x after one sweep that projects it onto each violated row in turn."""

    def project(x: Array, now: _Blocking) -> tuple[Array, None]:
        (row, lower, upper), direction = now
        value = jnp.sum(row * x)
        return x + (jnp.clip(value, lower, upper) - value) * direction, None

    return jax.lax.scan(project, x, blocking)[0]


def narrow_box(
    damping: Damping,
    level: Level | PaddedLevel,
    curvature: Float[Array, " n"],
    x: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Return a narrower box for the levels below a level that ended at x with a residual.

    A motion d of the levels below changes no row of this level at first order. At second order it costs the level up to
    ``1/2 residual size sum_j c_j d_j^2``, with the size (Frobenius norm) of its rows and the curvatures c. The level's
    gain is ``1/2 (demand^2 - residual^2)``. The box keeps the cost under a fraction of the gain, in equal parts for all
    variables. Without a residual the box stays. ``curvature`` bounds that of the levels above along each variable, in
    units of the Frobenius norm of their rows; it is returned with the level's own in it, behind the bounds.
    """
    longest_square = jnp.max(jnp.sum(level.matrix**2, -1), initial=0.0)
    size = safe_norm(level.matrix.ravel())
    # the level's own curvature, in units of the Frobenius norm of its rows
    curvature = jnp.maximum(curvature, quotient(damping.bends, jnp.where(size > 0.0, size, 1.0)))
    residual = jnp.minimum(safe_norm(level.distance(x)), damping.demand)
    ratio = quotient(residual, jnp.where(damping.demand > 0.0, damping.demand, 1.0))
    cost = residual * size * curvature
    is_restricted = (cost > NEGLIGIBLE_CURVATURE * jnp.max(cost)) & (
        damping.unmet * ratio > NEGLIGIBLE_DAMPING * longest_square
    )
    count = jnp.maximum(jnp.sum(is_restricted), 1)
    # cost_j radius_j^2 = gain / count for each variable that is restricted; all without the factor 1/2
    gain = COST_FRACTION * (damping.demand - residual) * (damping.demand + residual)
    radius = positive_root(quotient(gain, count * jnp.where(is_restricted, cost, 1.0))) + MIN_RADIUS
    radius = jnp.where(is_restricted, radius, jnp.inf)
    return jnp.maximum(lower, x - radius), jnp.minimum(upper, x + radius), curvature
