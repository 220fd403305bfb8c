"""A proposal for the working set of a level: the dual method on the level made strictly convex by a little damping.

    min 1/2 |A_e d + r|^2 + 1/2 damping |x + d|^2 + 1/2 little |d|^2 + 1/2 |t|^2

over d in the frozen rows' null space, with the hard rows kept and the level's inequality rows held up to t.
Its tableau over the rows alone costs one factorisation, and each change of the working set one rank-1 update. What it
proposes is then solved and judged without the damping (``land``).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._dense import apply, product
from .._pivots import AT_UPPER, INACTIVE, Dual, Limits, Noise, begin, search
from ._problem import WorkingSet
from ._stack import Task

_DAMPING = 1e-9
"""Of the level, whatever its own: the tableau needs some."""
_NOISE = 1e-10


def propose(
    task: Task, wanted: Bool[Array, " B"], max_iterations: int
) -> tuple[Float[Array, "B n"], WorkingSet, Int[Array, " B"]]:
    """Points and working sets for the lanes that want them, and the changes it took; every array has a leading axis."""
    limits, root, start = jax.vmap(_tableau)(task)
    none = jnp.zeros(len(wanted), jnp.int32)
    end = search(limits, start, searching=wanted, iterations=none, max_iterations=max_iterations)
    return jax.vmap(_point)(task, root, end), jax.vmap(_working_set)(task, end), end.iterations


def _tableau(task: Task) -> tuple[Limits, Float[Array, " h"], Dual]:
    level, x, dtype = task.level, task.x, task.x.dtype
    scale = 1.0 / jnp.where(task.size > 0.0, task.size, 1.0)
    damping = task.damping * scale**2
    cost = jnp.where(task.equal[:, None], product(level.matrix * scale, task.projector), 0.0)
    residual = scale * jnp.where(task.equal, apply(level.matrix, x) - jnp.where(task.equal, level.lower, 0.0), 0.0)
    hessian = product(cost.T, cost) + (damping + _DAMPING) * jnp.eye(len(x), dtype=dtype)
    factor = jax.lax.linalg.cholesky(hessian, symmetrize_input=False)
    unit = jnp.where(task.own, scale, 1.0)  # the rows of the level in the units of its cost
    rows = product(task.matrix * unit[:, None], task.projector)
    downhill = apply(cost.T, residual) + damping * apply(task.projector, x)
    right = jnp.concatenate([rows.T, downhill[:, None]], 1)
    half = jax.scipy.linalg.solve_triangular(factor, right, lower=True)
    half, slope = half[:, :-1], half[:, -1]
    tableau = product(half.T, half) + jnp.diag(task.soft.astype(dtype))
    own = jnp.diagonal(tableau)
    root = 1.0 / jnp.sqrt(jnp.where(own > 0.0, own, 1.0))
    value = unit * apply(task.matrix, x) - apply(half.T, slope)
    bounds = [
        jnp.where(task.free | task.soft, unit * b, side) for b, side in ((task.lower, -jnp.inf), (task.upper, jnp.inf))
    ]
    nearest = jnp.minimum(*(jnp.where(jnp.isfinite(b), jnp.abs(b), jnp.inf) for b in bounds))
    reach = unit * task.length * jnp.max(jnp.abs(x)) + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    small = root * _NOISE * (reach + jnp.abs(value))
    limits = Limits(
        lower=bounds[0] * root,
        upper=bounds[1] * root,
        equality=jnp.zeros(len(value), bool),
        noise=Noise(small, small),
        scale=jnp.where(own > 0.0, 1.0, 0.0).astype(dtype),
    )
    inactive = jnp.full(len(value), INACTIVE, jnp.int32)
    start = begin(tableau * root[:, None] * root[None, :], value * root, jnp.zeros_like(value), inactive)
    return limits, root, start


def _point(task: Task, root: Float[Array, " h"], end: Dual) -> Float[Array, " n"]:
    """The damped minimiser: the values of the box's rows, with the frozen rows as they were."""
    n = len(task.x)
    return task.x + apply(task.projector, (end.value / root)[:n] - task.x)


def _working_set(task: Task, end: Dual) -> WorkingSet:
    side = jnp.where(end.active == INACTIVE, 0, jnp.where(end.active == AT_UPPER, 1, -1)).astype(jnp.int32)
    own = jnp.where(task.equal, 2, jnp.pad(side, (0, 1))[task.place])
    return WorkingSet(jnp.where(task.own, 0, side), own.astype(jnp.int32))
