"""All tasks in one quadratic program, traded off by weight (eqs. 4 and 5)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._joint_selection import concrete
from ..solvers import solve_least_squares_qp
from ..tasks import TaskRows
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, as_leaf


class WeightedQP(Scheme):
    """min 1/2 sum_i weight_i |J_i v - wanted_i|^2 + 1/2 damping |v|^2  subject to the box.

    Weights multiply squared residuals (pink and mink: ``weight = cost**2``). Rows of inequality tasks cost the square
    of their distance to the interval. Priorities are ignored. Smooth where tasks conflict; no task is met exactly while
    another pulls against it.

    Attributes:
        damping: of the velocity, in the units of weight times J^2; > 0.
        max_iterations: cap on changes of the active set (static).
    """

    damping: Float[Array, ""] = eqx.field(default=1e-8, converter=as_leaf("damping"))
    max_iterations: int | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        seen = concrete(self.damping)
        if seen is not None and not (seen > 0.0).all():
            raise ValueError(f"damping is {seen}; a WeightedQP needs it positive, or the velocity is not unique")

    def solve(self, problem: VelocityProblem) -> SchemeAnswer:
        """The velocity of one tick."""
        equalities = [rows for rows in problem.rows.values() if rows.is_equality]
        intervals = [rows for rows in problem.rows.values() if not rows.is_equality]
        n = problem.lower.shape[0]
        answer = solve_least_squares_qp(
            **_stack(equalities, intervals, n, problem.lower.dtype),
            **_bounds(intervals, problem),
            damping=_damping(self.damping, intervals, n, problem.lower.dtype),
            max_iterations=self.max_iterations,
        )
        return SchemeAnswer(answer.x[:n], answer.status, answer.iterations, answer.kkt_residual)


def _stack(equalities: list[TaskRows], intervals: list[TaskRows], n: int, dtype: jnp.dtype) -> dict[str, Array]:
    """Least squares over [v; s], where s are the slacks of the interval rows."""
    rows = sum(r.weight.shape[0] for r in equalities)
    slacks = sum(r.weight.shape[0] for r in intervals)
    matrix = jnp.concatenate([r.jacobian for r in equalities] + [jnp.zeros((slacks, n), dtype)])
    extra = jnp.concatenate([jnp.zeros((rows, slacks), dtype), jnp.eye(slacks, dtype=dtype)])
    return dict(
        matrix=jnp.concatenate([matrix, extra], 1),
        target=jnp.concatenate([r.lower for r in equalities] + [jnp.zeros(slacks, dtype)]),
        weight=jnp.concatenate([r.weight for r in [*equalities, *intervals]]),
    )


def _damping(damping: Array, intervals: list[TaskRows], n: int, dtype: jnp.dtype) -> Array:
    """Of v; slacks have a cost of their own, but for those of weight 0, which nothing moves from 0."""
    slacks = [jnp.where(r.weight > 0.0, 0.0, 1.0).astype(dtype) for r in intervals]
    return jnp.concatenate([jnp.full(n, damping, dtype), *slacks])


def _bounds(intervals: list[TaskRows], problem: VelocityProblem) -> dict[str, Array]:
    """The box on v, and J v - s within the intervals."""
    if not intervals:
        return dict(lower=problem.lower, upper=problem.upper)
    slacks = sum(r.weight.shape[0] for r in intervals)
    free = jnp.full(slacks, jnp.inf, problem.lower.dtype)
    jacobian = jnp.concatenate([r.jacobian for r in intervals])
    counts = jnp.concatenate([r.weight > 0.0 for r in intervals])
    return dict(
        lower=jnp.concatenate([problem.lower, -free]),
        upper=jnp.concatenate([problem.upper, free]),
        rows=jnp.concatenate([jacobian, -jnp.eye(slacks, dtype=jacobian.dtype)], 1),
        rows_lower=jnp.where(counts, jnp.concatenate([r.lower for r in intervals]), -free),
        rows_upper=jnp.where(counts, jnp.concatenate([r.upper for r in intervals]), free),
    )
