"""The reverse order: from the lowest level to the highest, each disturbing those before it as little as it can.

F. Flacco, A. De Luca, "A reverse priority approach to multi-task control of redundant robots", IROS 2014:

    v_k = v_{k+1} + T_k (J_k T_k)^+ (b_k - J_k v_{k+1}),    T_k: the last columns of [J_l; ...; J_{k+1}; J_k]^+

The change of step k is, of all that fulfil level k as nearly as its own J_k allows, the one that moves the rows of the
levels below least, and the smallest of these; it is computed as such,

    d = J_k^+ r - N D B J_k^+ r,    N = I - J_k^+ J_k,    B = [J_l; ...; J_{k+1}],    D = (B N)^+

which needs no inverse of an inverse. With damping, D = (N B' B N + damping I)^-1 N B': the one place where levels meet
takes no rank decision, so that the answer is a smooth function of the data where each J_k by itself keeps its rank,
and bounded. The highest level comes last and therefore gets all that J_1 alone can give, dependent levels or not.

When not to use it: three or more levels whose middle one has to come before the lowest in all it can get (where levels
contradict each other, the least squares of B mixes the levels below; the forward order and ``solve_hqp`` do not);
hard bounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._dense import apply, product
from ..hqp import Level
from ._inverses import regularised_inverse, row_space_and_inverse
from ._problem import Demand


def solve_reverse(
    levels: Sequence[Level], secondary: Float[Array, " n"], damping: Array, rank: Array | float
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The answer, and the projector onto what no level asks for. The secondary motion comes first of all."""
    x = secondary
    eye = jnp.eye(len(x), dtype=x.dtype)
    below = jnp.zeros((0, len(x)), x.dtype)
    for level in reversed(levels):
        if not level.matrix.shape[0]:
            continue
        demand = Demand.of(level, x, rank)
        space, damped = row_space_and_inverse(demand.rows, demand.cutoff, damping)
        own = apply(damped, demand.wanted)
        x = x + own - _correction(below, own, eye - space, damping, rank)
        below = jnp.concatenate([below, demand.rows])
    space, _ = row_space_and_inverse(below, _cutoff(below, rank), damping) if len(below) else (0.0 * eye, None)
    return x, eye - space


def _correction(
    below: Float[Array, "b n"], own: Float[Array, " n"], free: Float[Array, "n n"], damping: Array, rank: Array | float
) -> Float[Array, " n"]:
    """What the level's null space can undo of what its motion does to the levels below."""
    if not len(below):
        return jnp.zeros_like(own)
    inverse = regularised_inverse(product(below, free), _cutoff(below, rank), damping)
    return apply(free, apply(inverse, apply(below, own)))


def _cutoff(rows: Float[Array, "m n"], rank: Array | float) -> Float[Array, ""]:
    return rank * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2))
