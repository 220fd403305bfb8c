"""Fallback without an answer: a bounded point of the box that is no worse than zero."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...numerics._constants import GRADIENT_STEPS
from ...numerics._dense import apply
from .._box import clip_to_box, violation
from ._problem import QP, softened_compliance


def projected_gradient(qp: QP) -> Float[Array, " n"]:
    """Return a point of the box for one problem: a hundred projected gradient steps from the zero vector.

    Each step divides the gradient by a diagonal bound on the Hessian, variable by variable (majorisation), so the cost
    never rises and no unit matters. Directions of a curvature under about a hundredth of the bound are hardly moved
    along, as under a damping of that size: what is nearly undetermined stays small. Hard rows add their squared
    violation, at the price of the largest curvature of the cost.
    """
    n = qp.rows.shape[1]
    box, intervals = (qp.lower[:n], qp.upper[:n]), (qp.lower[n:], qp.upper[n:])
    penalty = 1.0 / softened_compliance(qp, 1.0)
    size = jnp.abs(qp.rows)
    # row sums of |C|' penalty |C| bound C' penalty C as those of |H| bound H (Gershgorin)
    bound = qp.cost.curvature_bound() + apply(size.T, penalty * jnp.sum(size, 1))

    def step(_: Array, x: Array) -> Array:
        gradient = qp.cost.gradient(x) + apply(qp.rows.T, penalty * violation(apply(qp.rows, x), *intervals))
        return clip_to_box(x - gradient / jnp.where(bound > 0.0, bound, 1.0), *box)

    return jax.lax.fori_loop(0, GRADIENT_STEPS, step, clip_to_box(jnp.zeros_like(bound), *box))
