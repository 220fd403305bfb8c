"""Prioritised least squares by null-space projection (eqs. 6 and 7). No box: what it says is what comes out.

    v_k = v_{k-1} + (J_k P_{k-1})^+ (b_k - J_k v_{k-1}),    P_k = P_{k-1} - (J_k P_{k-1})^+ (J_k P_{k-1})

with the Moore-Penrose inverse, singular values below a share of the level's own size cut off. Damping acts on the
motion term alone; in the projector it would break idempotency, and lower levels would leak into higher ones.

When not to use it: where bounds or inequalities have to hold (``solve_hqp``). An inequality row takes part only
while the levels above it leave it violated, and nothing keeps lower levels from violating it again.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._dense import apply, product, pseudo_inverses
from ._status import Status
from .hqp import Level

_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}


class NullSpaceSolution(eqx.Module):
    """Answer of the projection.

    Attributes:
        x: the answer. (n,)
        slacks: of each level, A x minus the nearest point of its interval (unweighted). ((m,), ...)
        status: SOLVED, or NUMERICAL_ERROR where the input is not finite (x is then 0).
        projector: onto what no level asks for; the secondary motion went through it. (n, n)
    """

    x: Float[Array, " n"]
    slacks: tuple[Float[Array, " m"], ...]
    status: Int[Array, ""]
    projector: Float[Array, "n n"]


@jax.jit
def solve_nullspace(
    levels: Sequence[Level],
    *,
    secondary: Float[Array, " n"] | None = None,
    damping: Float[Array, ""] | float = 0.0,
    rank_tolerance: Float[Array, ""] | float | None = None,
) -> NullSpaceSolution:
    """Each level as nearly as the null space of the levels before it allows.

    Pure, compiled on first use, batched by ``vmap``.

    Args:
        levels: highest priority first. A row with lower < upper counts only where the levels before leave it violated.
        secondary: motion projected onto the null space of all levels, such as a potential's descent. (n,)
        damping: of the motion of each level, in squared singular values: s / (s^2 + damping) stands for 1 / s.
        rank_tolerance: singular values of A P under this share of the Frobenius norm of A (P projects onto what the
            levels before leave free) count as zero; default 1e-10 (1e-5 in float32). Against A and not A P, so that
            a level which repeats one above it has rank 0, not the rank of its rounding.
    """
    n = levels[0].matrix.shape[1]
    dtype = jnp.result_type(*(level.matrix for level in levels))
    cut = _RANK[dtype] if rank_tolerance is None else rank_tolerance
    x, projector = jnp.zeros(n, dtype), jnp.eye(n, dtype=dtype)
    for level in (level.scaled() for level in levels):
        x, projector = _project(level, x, projector, jnp.asarray(damping, dtype), cut)
    if secondary is not None:
        x = x + apply(projector, secondary)
    good = jnp.isfinite(x).all()
    x = jnp.where(good, x, 0.0)
    return NullSpaceSolution(
        x=x,
        slacks=tuple(jnp.where(good, level.distance(x), 0.0) for level in levels),
        status=jnp.where(good, Status.SOLVED, Status.NUMERICAL_ERROR),
        projector=projector,
    )


def _project(
    level: Level, x: Float[Array, " n"], projector: Float[Array, "n n"], damping: Array, cut: Array | float
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    if not level.matrix.shape[0]:
        return x, projector
    value = apply(level.matrix, x)
    wanted = jnp.clip(value, level.lower, level.upper) - value
    counts = (level.lower == level.upper) | (wanted != 0.0)
    rows = jnp.where(counts[:, None], level.matrix, 0.0)
    restricted = product(rows, projector)
    cutoff = cut * jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2))
    inverse, damped = pseudo_inverses(restricted, cutoff, damping)
    return x + apply(damped, wanted), projector - product(inverse, restricted)
