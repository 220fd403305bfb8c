"""All tasks in one quadratic program, traded off by weight (eqs. 4 and 5)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._errors import OsikValueError
from ..execution._backends import check_backend, takes
from ..numerics._arguments import concrete
from ..solvers import Backend, Level, solve_least_squares_qp
from ..tasks import TaskRows
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, as_cap, as_leaf

_ROUNDINGS = 4.0
"""Of the largest weight times row norm squared; a weaker damping is lost in single arithmetic."""

_SPARED = 30.0
"""Curvature damping is spared where it is below this many times what holds a dof anyway."""


class WeightedQP(Scheme):
    """min 1/2 sum_i weight_i |J_i v - wanted_i|^2 + 1/2 damping |v|^2  subject to the box.

    Weights multiply squared residuals (pink and mink: ``weight = cost**2``). Rows of inequality tasks cost the square
    of their distance to the interval. Hard tasks and limits with rows are rows of the program that cost nothing and do
    not give way; where they contradict each other or the box, they are missed by as little as can be and the answer is
    INFEASIBLE. Priorities are ignored. Smooth where tasks conflict; no task is met exactly while
    another pulls against it.

    Attributes:
        damping: of the velocity, in the units of weight times J^2; > 0. In float32 on a GPU with kernels, what holds a
            dof, its damping and its posture together, is at least a few roundings of the largest weight times row norm
            squared.
        curvature_damping: kappa, the share of what the linear model leaves out that is added to the damping; 0 for
            none. What is added vanishes where the tasks are met (``TaskRows.curvature``), with the square of their
            error where a posture or the damping holds a dof anyway.
        max_iterations: cap on changes of the active set (static).
        backend: whose candidates for the answer are taken, as in ``solve_least_squares_qp`` (static).
    """

    damping: Float[Array, ""] = eqx.field(default=1e-8, converter=as_leaf("damping"))
    curvature_damping: Float[Array, ""] = eqx.field(default=1.25, converter=as_leaf("curvature_damping"), kw_only=True)
    max_iterations: int | None = eqx.field(default=None, static=True, converter=as_cap)
    backend: Backend = eqx.field(default="auto", static=True, kw_only=True, converter=check_backend)

    def __check_init__(self) -> None:
        self._check()

    def _check(self) -> None:
        seen = concrete(self.damping)
        if seen is not None and not (seen > 0.0).all():
            raise OsikValueError(f"damping is {seen}; a WeightedQP needs it positive, or the velocity is not unique")

    def solve(self, problem: VelocityProblem, warm_start: Int[Array, " m"] | None = None) -> SchemeAnswer:
        """The velocity of one step; the warm start is the active set, of the box and of the inequality rows."""
        equalities = [rows for rows in problem.soft().values() if rows.is_equality]
        intervals = [rows for rows in problem.soft().values() if not rows.is_equality]
        bend = self.curvature_damping * problem.curvature(problem.soft())
        answer = solve_least_squares_qp(
            *_stack([rows for rows in equalities if rows.dofs is None], problem),
            problem.lower,
            problem.upper,
            **_rows(intervals, problem.constraints()),
            **_pulls([rows for rows in equalities if rows.dofs is not None], problem, self.damping, bend, self.backend),
            warm_start=warm_start,
            max_iterations=self.max_iterations,
            backend=self.backend,
        )
        return SchemeAnswer(
            answer.x, answer.status, answer.iterations, answer.factorizations, answer.kkt_residual, answer.active
        )


def _least(problem: VelocityProblem, backend: Backend) -> Float[Array, ""]:
    """The weakest damping that a kernel of single precision can tell from the rounding of the Hessian; 0 for none."""
    rows = list(problem.soft().values())
    dtype = problem.lower.dtype
    if dtype != jnp.float32 or not rows or not takes(backend, "warp", fits=True):
        return jnp.zeros((), dtype)
    steepest = [jnp.max(r.weight * jnp.sum(r.jacobian**2, 1), initial=0.0) for r in rows]
    return jax.lax.stop_gradient(_ROUNDINGS * float(jnp.finfo(dtype).eps) * jnp.max(jnp.stack(steepest)))


def _pulls(
    singles: list[TaskRows],
    problem: VelocityProblem,
    damping: Float[Array, ""],
    bend: Float[Array, ""],
    backend: Backend,
) -> dict[str, Array]:
    """Rows that each ask for one dof's velocity, with the damping: a strength and a centre for each dof.

    Of the curvature damping ``bend`` a dof that is held with strength s anyway takes ``bend^2 / (bend + 30 s)``: all of
    it out of reach, and next to none beside a posture that is strong enough to calm what is left of an error
    (docs/paper.md, "Curvature damping").
    """
    n = problem.lower.shape[0]
    strength, pull = jnp.full(n, damping, problem.lower.dtype), jnp.zeros(n, problem.lower.dtype)
    for rows in singles:
        place = np.full(n, len(rows.dofs or ()))
        place[np.array(rows.dofs, int)] = np.arange(len(rows.dofs or ()))
        usable = jnp.where(jnp.isnan(rows.weight), 1.0, rows.weight)  # times NaN, a derivative of nought is NaN
        weight, wanted = (jnp.append(a, 0.0)[place] for a in (usable, usable * rows.lower))
        strength, pull = strength + weight, pull + wanted
    whole = bend + _SPARED * strength
    strength = strength + bend * (bend / jnp.where(whole > 0.0, whole, 1.0))  # bend^2 of a far target overflows
    least = _least(problem, backend)
    strength = jnp.where(strength < least, least, strength)
    center = pull / strength
    for rows in singles:
        strength = jnp.where(jnp.isnan(rows.weight).any(), jnp.nan, strength)
    return dict(damping=strength, center=center)


def _stack(equalities: list[TaskRows], problem: VelocityProblem) -> tuple[Array, Array, Array]:
    """Matrix, target and weight of equality rows."""
    nothing = jnp.zeros((0, problem.lower.shape[0]), problem.lower.dtype)
    none = nothing[:, 0]
    return (
        jnp.concatenate([nothing, *(r.jacobian for r in equalities)]),
        jnp.concatenate([none, *(r.lower for r in equalities)]),
        jnp.concatenate([none, *(r.weight for r in equalities)]),
    )


def _rows(intervals: list[TaskRows], constraints: Level | None) -> dict[str, Any]:
    """The rows that give way, then those that do not."""
    soft = _soft_rows(intervals)
    if constraints is None:
        return soft
    hard = constraints.scaled()
    stiff = dict(
        rows=hard.matrix, rows_lower=hard.lower, rows_upper=hard.upper, rows_compliance=jnp.zeros_like(hard.lower)
    )
    both = {name: jnp.concatenate([soft[name], array]) if soft else array for name, array in stiff.items()}
    count = len(both["rows"]) - len(hard.lower)
    return both | dict(rows_equalities=(False,) * count + hard.equalities)


def _soft_rows(intervals: list[TaskRows]) -> dict[str, Array]:
    """Inequality rows, which give way at the price of their weight; a row of weight 0 has no bounds."""
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
