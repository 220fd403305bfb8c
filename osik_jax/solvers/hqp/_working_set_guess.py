"""Guess of a level's working set: the dual method on the level, made strictly convex by a small damping.

    min 1/2 |A_e d + r|^2 + 1/2 damping |x + d|^2 + 1/2 extra |d|^2 + 1/2 |t|^2

over d in the frozen rows' null space, with the hard rows kept and the level's inequality rows kept up to t. The tableau
over the rows alone costs one factorisation, and each change of the working set one update of rank 1
(docs/dev/derivations.md, "The dual active-set step"). The level is then solved on the guessed set without the extra
damping (``solve_on_working_set``), which decides whether the guess is right.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...numerics._constants import AT_UPPER, EXTRA_DAMPING, GUESS_ROUNDOFF, INACTIVE
from ...numerics._dense import apply, product
from .._goldfarb_idnani import Constraints, DualState, Roundoff, dual_active_set, initial_state
from ._padding import LevelProblem
from ._problem import WorkingSet


def guess_working_set(
    problem: LevelProblem, wanted: Bool[Array, " B"], max_iterations: int
) -> tuple[Float[Array, "B n"], WorkingSet, Int[Array, " B"]]:
    """Guess the working set of each level of a batch by the dual method.

    Args:
        problem: the levels; every array has a leading axis.
        wanted: problems for which a guess is asked for; the others stay at an empty working set. (B,)
        max_iterations: limit on the changes of one working set (static).

    Returns:
        The damped minimisers, the working sets, and how many changes they took.
    """
    constraints, root, start = jax.vmap(_tableau)(problem)
    zeros = jnp.zeros(wanted.shape[0], jnp.int32)
    end = dual_active_set(constraints, start, searching=wanted, iterations=zeros, max_iterations=max_iterations)
    return jax.vmap(_minimiser)(problem, root, end), jax.vmap(_working_set)(problem, end), end.iterations


def _tableau(problem: LevelProblem) -> tuple[Constraints, Float[Array, " h"], DualState]:
    """Return bounds and start of the dual method without active rows, and the scale of each row."""
    level, x, dtype = problem.level, problem.x, problem.x.dtype
    scale = 1.0 / jnp.where(problem.size > 0.0, problem.size, 1.0)
    damping = problem.damping * scale**2
    is_equality = problem.is_equality
    cost = jnp.where(is_equality[:, None], product(level.matrix * scale, problem.projector), 0.0)
    residual = scale * jnp.where(is_equality, apply(level.matrix, x) - jnp.where(is_equality, level.lower, 0.0), 0.0)
    # equality rows are the cost, H = A_e' A_e + (damping + extra) I; inequality rows are constraints with a slack t
    hessian = product(cost.T, cost) + (damping + EXTRA_DAMPING) * jnp.eye(len(x), dtype=dtype)
    factor = jax.lax.linalg.cholesky(hessian, symmetrize_input=False)
    unit = jnp.where(problem.is_own, scale, 1.0)  # the rows of the level in the units of its cost
    rows = product(problem.hard * unit[:, None], problem.projector)
    gradient = apply(cost.T, residual) + damping * apply(problem.projector, x)
    # with H = L L', the columns of half are L^-1 G' and the last one is L^-1 gradient: T = G H^-1 G'
    right = jnp.concatenate([rows.T, gradient[:, None]], 1)
    half = jax.scipy.linalg.solve_triangular(factor, right, lower=True)
    half, half_gradient = half[:, :-1], half[:, -1]
    # a slack that costs 1/2 t^2 adds 1 to its diagonal element
    tableau = product(half.T, half) + jnp.diag(problem.is_own_inequality.astype(dtype))
    # rows and columns are scaled so that the diagonal of T is 1
    diagonal = jnp.diagonal(tableau)
    root = 1.0 / jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0))
    # the values of the rows at the minimiser without constraints, G x - G H^-1 gradient
    value = unit * apply(problem.hard, x) - apply(half.T, half_gradient)
    constrained = problem.may_block | problem.is_own_inequality
    bounds = [
        jnp.where(constrained, unit * bound, none)
        for bound, none in ((problem.lower, -jnp.inf), (problem.upper, jnp.inf))
    ]
    nearest = jnp.minimum(*(jnp.where(jnp.isfinite(bound), jnp.abs(bound), jnp.inf) for bound in bounds))
    terms = unit * problem.length * jnp.max(jnp.abs(x)) + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    roundoff = root * GUESS_ROUNDOFF * (terms + jnp.abs(value))
    constraints = Constraints(
        lower=bounds[0] * root,
        upper=bounds[1] * root,
        equality=jnp.zeros(len(value), bool),
        roundoff=Roundoff(roundoff, roundoff),
        scale=jnp.where(diagonal > 0.0, 1.0, 0.0).astype(dtype),
    )
    inactive = jnp.full(len(value), INACTIVE, jnp.int32)
    start = initial_state(tableau * root[:, None] * root[None, :], value * root, jnp.zeros_like(value), inactive)
    return constraints, root, start


def _minimiser(problem: LevelProblem, root: Float[Array, " h"], end: DualState) -> Float[Array, " n"]:
    """Return the damped minimiser.

    The first n rows are the box, so their values are x; frozen rows keep their values.
    """
    n = len(problem.x)
    return problem.x + apply(problem.projector, (end.value / root)[:n] - problem.x)


def _working_set(problem: LevelProblem, end: DualState) -> WorkingSet:
    active = jnp.where(end.active == INACTIVE, 0, jnp.where(end.active == AT_UPPER, 1, -1)).astype(jnp.int32)
    # rows of the level without a hard row of their own have index h, where the padding says inactive
    own = jnp.where(problem.is_equality, 2, jnp.pad(active, (0, 1))[problem.hard_of_row])
    return WorkingSet(jnp.where(problem.is_own, 0, active), own.astype(jnp.int32))
