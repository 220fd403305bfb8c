"""Strict priorities: no task gives way to one below it (eq. 9)."""

from __future__ import annotations

import equinox as eqx

from ..solvers import WorkingSet, solve_hqp
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, status_with


class HierarchicalQP(Scheme):
    """Lexicographic least squares over the priorities, inside the box at every level.

    Hard tasks and limits with rows are the first level, before all priorities; where they are missed, the answer is
    INFEASIBLE.

    Equality and inequality tasks may stand at any level; weights trade off tasks of the same priority. Where a level
    cannot be met it is missed by as little as possible, and the levels below use what freedom is left.

    Attributes:
        max_iterations: cap on the active-set iterations of one level (static).
    """

    max_iterations: int | None = eqx.field(default=None, static=True)

    def solve(self, problem: VelocityProblem, warm_start: WorkingSet | None = None) -> SchemeAnswer:
        """The velocity of one tick; the warm start is the working set of every level."""
        constraints = problem.constraints()
        answer = solve_hqp(
            problem.levels(constraints),
            problem.lower,
            problem.upper,
            warm_start=warm_start,
            max_iterations=self.max_iterations,
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
