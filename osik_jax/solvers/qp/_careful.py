"""What to do where there is no answer: a step that is feasible, bounded and no worse than none."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._box import clip_to_box, outside
from .._dense import apply
from ._problem import QP, given_way

_STEPS = 100


def careful_step(qp: QP) -> Float[Array, " n"]:
    """A point of the box, one problem: downhill from the zero vector, clipped into the box, by a hundred short steps.

    Each goes along the slope over a bound on the curvature, variable by variable, so that the cost never rises and no
    unit matters. Directions that bend the cost by less than about a hundredth of the bound are hardly moved along, as
    under a damping of that size: what is nearly undetermined stays small. Hard rows add their squared violation, at
    the price of the heaviest direction of the cost.
    """
    n = qp.rows.shape[1]
    box, sides = (qp.lower[:n], qp.upper[:n]), (qp.lower[n:], qp.upper[n:])
    price = 1.0 / given_way(qp, 1.0)
    size = jnp.abs(qp.rows)
    bend = qp.cost.bend() + apply(size.T, price * jnp.sum(size, 1))

    def on(_: Array, x: Array) -> Array:
        slope = qp.cost.gradient(x) + apply(qp.rows.T, price * outside(apply(qp.rows, x), *sides))
        return clip_to_box(x - slope / jnp.where(bend > 0.0, bend, 1.0), *box)

    return jax.lax.fori_loop(0, _STEPS, on, clip_to_box(jnp.zeros_like(bend), *box))
