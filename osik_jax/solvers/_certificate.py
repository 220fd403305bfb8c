"""What a verdict rests on: optimality, as a share of the problem's own forces; contradictions, by what proves them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._dense import apply

_FAR = 1e3
_ROUNDING = 1e-14
"""Share of the terms of a sum that is not told from 0."""


def contradiction(
    rows: Float[Array, "p n"],
    proof: Float[Array, " p"],
    gap: Float[Array, " p"],
    x: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Whether a vector of Farkas proves that nothing in the box satisfies the rows.

    Weighed with it, the rows have to move by proof'gap before all of them can hold. In the box they move by the sum of
    |C'proof| times the way to the bound that it pushes to, at most. Where there is no bound, no x counts that is more
    than a thousand times as large as what is at hand.

    Args:
        rows: C.
        proof: a number for each row, of the sign of its gap; the gaps themselves at the least violation.
        gap: C x minus the nearest points of the intervals; 0 for rows that do not count.
        x: a point in the box.
        lower: of the box.
        upper: of the box.
    """
    pull = apply(rows.T, proof)
    rounding = _ROUNDING * apply(jnp.abs(rows).T, jnp.abs(proof))
    pull = jnp.where(jnp.abs(pull) <= rounding, 0.0, pull)
    sizes = [jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0) for a in (x, lower, upper)]
    far = _FAR * jnp.max(jnp.stack(sizes), initial=0.0)
    way = jnp.where(pull > 0.0, x - lower, upper - x)
    reachable = jnp.sum(jnp.abs(pull) * jnp.where(jnp.isfinite(way), way, far))
    return jnp.dot(proof, gap) > reachable


def kkt_share(
    left: Float[Array, " k"], forces: Float[Array, " n"], gap: Float[Array, " p"], scale: Float[Array, " p"]
) -> Float[Array, ""]:
    """How far a point is from optimal, without units: comparable between problems, whatever their weights.

    Args:
        left: forces that nothing holds, and those that push away from their bound (not positive where they do not).
        forces: at each variable, the sum of the absolute terms that the slope of the cost and the multipliers add.
        gap: by how much each row is violated.
        scale: of each row: what its terms and bounds amount to.

    Returns:
        The larger of two: the largest force left, as a share of the largest force, and the largest gap, of its scale.
    """
    most = jnp.max(forces, initial=0.0)
    force = jnp.maximum(jnp.max(left, initial=0.0), 0.0) / jnp.where(most > 0.0, most, 1.0)
    missed = jnp.where(gap > 0.0, gap / jnp.where(scale > 0.0, scale, 1.0), 0.0)
    return jnp.maximum(force, jnp.max(missed, initial=0.0))
