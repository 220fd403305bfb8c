"""Certificates of a status: relative KKT residual of an answer, and Farkas certificates of infeasible rows."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..execution._platform import cuda_is_default
from ..numerics._constants import FARKAS_MARGIN, FARKAS_RADIUS, FARKAS_ROUNDOFF
from ..numerics._dense import apply


def is_farkas_certificate(
    rows: Float[Array, "p n"],
    certificate: Float[Array, " p"],
    gap: Float[Array, " p"],
    x: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Check that a Farkas vector z proves that no point of the box satisfies the rows C.

    Where all rows hold at x + d, ``-z'C d`` is at least ``z'gap``; in the box it is at most the sum of |C'z|_j times
    the distance of x_j to its bound in the direction of -(C'z)_j. If the latter is smaller, there is no such d. Where a
    variable has no such bound, values up to a thousand times those at hand are considered. z has the sign of the gap in
    each row: the gaps themselves at the least violation. The gap is C x minus the nearest point of each row's interval,
    0 for rows that do not count; x is in the box.
    """
    # -z'C d as a linear function of d, whose coefficients below roundoff are 0
    gradient = apply(rows.T, certificate)
    roundoff = FARKAS_ROUNDOFF * apply(jnp.abs(rows).T, jnp.abs(certificate))
    gradient = jnp.where(jnp.abs(gradient) <= roundoff, 0.0, gradient)
    sizes = [jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0) for a in (x, lower, upper)]
    radius = FARKAS_RADIUS * jnp.max(jnp.stack(sizes), initial=0.0)
    # the most that this function reaches in the box: each variable at the bound that raises it
    distance = jnp.where(gradient > 0.0, x - lower, upper - x)
    largest_change = jnp.sum(jnp.abs(gradient) * jnp.where(jnp.isfinite(distance), distance, radius))
    return jnp.dot(certificate, gap) > (1.0 + FARKAS_MARGIN) * largest_change


def relative_kkt_residual(
    stationarity: Float[Array, " n"],
    gradient_scale: Float[Array, " n"],
    wrong_sign: Float[Array, " p"],
    violation: Float[Array, " p"],
    violation_scale: Float[Array, " p"],
) -> Float[Array, ""]:
    """Return the KKT residual of a point without units, comparable between problems of any weights.

    It is the larger of two: the largest stationarity residual or wrong multiplier over the largest gradient scale, and
    the largest violation of a row over the size of its terms and bounds. ``stationarity`` has the gradient of the
    Lagrangian at variables without an active bound, and at the others multipliers of the wrong sign (not positive where
    the sign is right). A gradient scale is the sum of the gradient's absolute terms; ``wrong_sign`` is in units of the
    gradient.
    """
    residual, scale = largest_of_each(stationarity, gradient_scale)
    # stationarity and signs in units of the forces; feasibility in those of the rows' own terms
    dual = jnp.maximum(residual, jnp.max(wrong_sign, initial=0.0)) / jnp.where(scale > 0.0, scale, 1.0)
    relative = violation / jnp.where(violation_scale > 0.0, violation_scale, 1.0)
    primal = jnp.where(violation > 0.0, relative, 0.0)
    return jnp.maximum(dual, jnp.max(primal, initial=0.0))


def largest_of_each(*arrays: Float[Array, " n"]) -> list[Array]:
    """Return the largest entry of each array, at least 0: one operation for all, but on a GPU, where XLA's is slow."""
    if cuda_is_default():
        return [jnp.max(a, initial=0.0) for a in arrays]
    return list(jnp.max(jnp.stack(arrays), 1, initial=0.0))
