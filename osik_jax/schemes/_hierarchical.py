"""Strict priorities by hierarchical quadratic programs (eq. 9)."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from ..execution._backends import Backend, check_backend
from ..solvers import solve_hqp
from ..solvers.hqp import WorkingSet
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, as_leaf, as_max_iterations, status_with


class HierarchicalQP(Scheme):
    """Lexicographic least squares over the priorities, inside the box at every level.

    Hard tasks and limits with rows are the first level, before all priorities; where they are missed, the answer is
    INFEASIBLE.

    Equality and inequality tasks may stand at any level; weights trade off tasks of the same priority. Where a level
    cannot be met it is missed by as little as possible, and the levels below use what freedom is left.

    A priority with damping minimises its squared residuals and damping |v|^2 together; what its rows reach is kept by
    those below it, the freedom that they leave is not damped away.

    Attributes:
        damping: of the velocity at each priority, in the units of weight times J^2; >= 0.
        curvature_damping: kappa, the fraction of what each priority's linear model leaves out that is added to its
            damping, twice that below others; 0 for none. What is added vanishes where the tasks are met
            (``TaskRows.curvature``).
        max_iterations: limit on the active-set iterations of one level (static).
        backend: whose candidates for the answer are taken, as in ``solve_hqp`` (static).
    """

    damping: Float[Array, ""] = eqx.field(default=0.0, converter=as_leaf("damping"), kw_only=True)
    curvature_damping: Float[Array, ""] = eqx.field(default=1.0, converter=as_leaf("curvature_damping"), kw_only=True)
    max_iterations: int | None = eqx.field(default=None, static=True, converter=as_max_iterations)
    backend: Backend = eqx.field(default="auto", static=True, kw_only=True, converter=check_backend)

    def solve(self, problem: VelocityProblem, warm_start: WorkingSet | None = None) -> SchemeAnswer:
        """Return the velocity of one step; the warm start is the working set of every level."""
        constraints = problem.constraints()
        answer = solve_hqp(
            problem.levels(constraints),
            problem.lower,
            problem.upper,
            damping=problem.dampings(constraints, self.damping, self.curvature_damping),
            warm_start=warm_start,
            max_iterations=self.max_iterations,
            backend=self.backend,
        )
        status = answer.status
        if constraints is not None:
            status = status_with(constraints, status, answer.x)
        return SchemeAnswer(
            answer.x,
            status,
            answer.iterations,
            answer.factorizations,
            answer.kkt_residual,
            answer.warm_start,
        )
