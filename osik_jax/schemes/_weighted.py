"""All tasks in one quadratic program, traded off by weight (eqs. 4 and 5)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._errors import OsikValueError
from ..core import _cuda
from ..execution._backends import Backend, check_backend, takes
from ..execution._platform import cuda_is_default
from ..numerics._arguments import concrete
from ..numerics._constants import DIAGONAL_RATIO, SINGLE_DAMPING
from ..numerics._guarded import quotient
from ..solvers import Level, solve_least_squares_qp
from ..tasks import TaskRows
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, as_leaf, as_max_iterations


class WeightedQP(Scheme):
    """Scheme of one quadratic program: tasks share the robot by their weights.

        min 1/2 sum_i weight_i |J_i v - wanted_i|^2 + 1/2 damping |v|^2     subject to the box

    Weights multiply squared residuals (pink and mink: ``weight = cost**2``). Rows of inequality tasks cost the square
    of their distance to the interval (soft rows). Hard tasks and limits with rows are constraints (hard rows). If these
    are infeasible, the status is INFEASIBLE, and they are violated as little as possible. Priorities are ignored. The
    answer is smooth where tasks conflict, and then no task is met exactly.

    Attributes:
        damping: damping of the velocity, in the units of weight times J^2; > 0. In float32 on a GPU with kernels, the
            diagonal term of a dof, its damping and its posture together, is at least 4 epsilon times the largest weight
            times row norm squared.
        curvature_damping: kappa, the factor of the damping for the second-order terms that the linear model omits; 0
            for none. It vanishes where the tasks are met (``TaskRows.curvature``). For a dof that its damping and
            posture hold strongly, it vanishes with the square of the tasks' error.
        max_iterations: limit on changes of the active set (static).
        backend: choice of kernels, as in ``solve_least_squares_qp`` (static).
    """

    damping: Float[Array, ""] = eqx.field(default=1e-8, converter=as_leaf("damping"))
    curvature_damping: Float[Array, ""] = eqx.field(default=1.25, converter=as_leaf("curvature_damping"), kw_only=True)
    max_iterations: int | None = eqx.field(default=None, static=True, converter=as_max_iterations)
    backend: Backend = eqx.field(default="auto", static=True, kw_only=True, converter=check_backend)

    def __check_init__(self) -> None:
        self._check()

    def _check(self) -> None:
        damping = concrete(self.damping)
        if damping is not None and not (damping > 0.0).all():
            raise OsikValueError(f"damping is {damping}; a WeightedQP needs it positive, or the velocity is not unique")

    def solve(self, problem: VelocityProblem, warm_start: Int[Array, " m"] | None = None) -> SchemeAnswer:
        """Return the velocity of one step; the warm start is the active set, of the box and of the inequality rows."""
        equalities = [rows for rows in problem.soft().values() if rows.is_equality]
        intervals = [rows for rows in problem.soft().values() if not rows.is_equality]
        curvature, damping = problem.curvature(problem.soft())
        of_hard = problem.curvature_above(problem.soft(), problem.hard)
        answer = solve_least_squares_qp(
            *_stack([rows for rows in equalities if rows.dofs is None], problem),
            problem.lower,
            problem.upper,
            **_rows(intervals, problem.constraints()),
            **_diagonal_terms(
                [rows for rows in equalities if rows.dofs is not None],
                problem,
                self.damping,
                self.curvature_damping * (curvature + of_hard),
                self.curvature_damping * (damping + of_hard),
                self.backend,
            ),
            warm_start=warm_start,
            max_iterations=self.max_iterations,
            backend=self.backend,
        )
        return SchemeAnswer(
            answer.x, answer.status, answer.iterations, answer.factorizations, answer.kkt_residual, answer.active
        )


def _least_damping(problem: VelocityProblem, backend: Backend) -> Float[Array, ""]:
    """Return the least damping above the Hessian's roundoff in a single-precision kernel; 0 if there is none."""
    rows = list(problem.soft().values())
    dtype = problem.lower.dtype
    if dtype != jnp.float32 or not rows or not takes(backend, "core-cuda", fits=_cuda.installed()):
        return jnp.zeros((), dtype)
    # a row on one dof is a row of the identity, of length 1
    squared = [1.0 if r.dofs is not None else r.squared_lengths() for r in rows]
    largest = [jnp.max(r.weight * length, initial=0.0) for r, length in zip(rows, squared, strict=True)]
    return jax.lax.stop_gradient(SINGLE_DAMPING * float(jnp.finfo(dtype).eps) * jnp.max(jnp.stack(largest)))


def _diagonal_terms(
    single_dof: list[TaskRows],
    problem: VelocityProblem,
    damping: Float[Array, ""],
    curvature: Float[Array, ""],
    curvature_damping: Float[Array, ""],
    backend: Backend,
) -> dict[str, Array]:
    """Return the cost ``1/2 sum_i d_i (v_i - center_i)^2`` of the damping and of rows on one dof each.

    With the bound b on the tasks' curvature, a dof whose terms are d gets the fraction ``b / (b + 30 d)`` of the
    curvature damping: nearly all of it if a target is far out of reach, and almost none if its damping or its posture
    is strong enough (docs/dev/derivations.md, "Curvature damping"). ``single_dof`` are rows of tasks that ask for the
    velocity of one dof each. ``curvature`` is b, kappa times the bound on the tasks' curvature; ``curvature_damping``
    is kappa times what the tasks' own rows do not resist.
    """
    n = problem.lower.shape[0]
    diagonal, weighted = jnp.full(n, damping, problem.lower.dtype), jnp.zeros(n, problem.lower.dtype)
    for rows in single_dof:
        row_of_dof = np.full(n, len(rows.dofs or ()))
        row_of_dof[np.array(rows.dofs, int)] = np.arange(len(rows.dofs or ()))
        finite = jnp.where(jnp.isnan(rows.weight), 1.0, rows.weight)  # times NaN, a derivative of 0 is NaN
        weight, wanted = (jnp.append(a, 0.0)[row_of_dof] for a in (finite, finite * rows.lower))
        diagonal, weighted = diagonal + weight, weighted + wanted
    total = curvature + DIAGONAL_RATIO * diagonal
    diagonal = diagonal + curvature_damping * quotient(curvature, jnp.where(total > 0.0, total, 1.0))
    least = _least_damping(problem, backend)
    diagonal = jnp.where(diagonal < least, least, diagonal)
    center = quotient(weighted, jnp.where(diagonal > 0.0, diagonal, 1.0))
    for rows in single_dof:
        diagonal = jnp.where(jnp.isnan(rows.weight).any(), jnp.nan, diagonal)
    return dict(damping=diagonal, center=center)


def _stack(equalities: list[TaskRows], problem: VelocityProblem) -> tuple[Array, Array, Array]:
    """Return matrix, target and weight of equality rows."""
    no_rows = jnp.zeros((0, problem.lower.shape[0]), problem.lower.dtype)
    no_numbers = no_rows[:, 0]
    matrix = jnp.concatenate([no_rows, *(r.jacobian for r in equalities)])
    return (
        # on a GPU, kernels keep lanes last in memory: XLA would join and turn the rows anew for each use
        jax.lax.optimization_barrier(matrix) if cuda_is_default() else matrix,
        jnp.concatenate([no_numbers, *(r.lower for r in equalities)]),
        jnp.concatenate([no_numbers, *(r.weight for r in equalities)]),
    )


def _rows(intervals: list[TaskRows], constraints: Level | None) -> dict[str, Any]:
    """Return the soft rows, then the hard ones."""
    soft = _soft_rows(intervals)
    if constraints is None:
        return soft
    hard = constraints.scaled()
    hard_rows = dict(
        rows=hard.matrix, rows_lower=hard.lower, rows_upper=hard.upper, rows_compliance=jnp.zeros_like(hard.lower)
    )
    both = {name: jnp.concatenate([soft[name], array]) if soft else array for name, array in hard_rows.items()}
    count = len(both["rows"]) - len(hard.lower)
    return both | dict(rows_equalities=(False,) * count + hard.equalities)


def _soft_rows(intervals: list[TaskRows]) -> dict[str, Array]:
    """Return inequality rows as soft rows, of compliance 1 / weight; a row of weight 0 has no bounds."""
    if not intervals:
        return {}
    weight = jnp.concatenate([r.weight for r in intervals])
    counts = weight > 0.0
    return dict(
        rows=jnp.concatenate([r.jacobian for r in intervals]),
        rows_lower=jnp.where(counts, jnp.concatenate([r.lower for r in intervals]), -jnp.inf),
        rows_upper=jnp.where(counts, jnp.concatenate([r.upper for r in intervals]), jnp.inf),
        rows_compliance=1.0 / jnp.where(counts, weight, 1.0),
    )
