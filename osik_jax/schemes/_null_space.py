"""Prioritised projection with a joint-limit potential in the last null space (eqs. 7 and 8); or with hard limits."""

from __future__ import annotations

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..execution._backends import Backend, check_backend
from ..numerics._constants import EPSILON, NARROW_RANGE
from ..numerics._guarded import clipped
from ..solvers import Level, solve_nullspace
from ..solvers.null_space import NullSpaceSolution
from ._scheme import Scheme, SchemeAnswer, VelocityProblem, as_leaf, status_with

NullSpaceMethod = Literal["classical", "saturated"]
METHODS: tuple[str, ...] = get_args(NullSpaceMethod)


class NullSpace(Scheme):
    """Scheme that solves each priority in the null space of those above; the rest descends a joint-limit potential.

    The potential f = 1/(2 n) sum r_i / ((u_i - q_i)(q_i - l_i)), r_i = u_i - l_i, repels the n limited joints from
    their limits; the motion is -potential_gain df/dq. Limits are not hard: the answer may leave its box by
    ``Solution.box_violation``. Inequality rows count only while the levels above leave them violated.

    ``method="saturated"`` makes the limits hard (saturation in the null space). The other joints take over from joints
    at their limits. A priority that cannot be met inside the limits is scaled down and keeps its direction.

    Hard tasks and limits with rows are the first level, without damping. If it cannot be met, the status is INFEASIBLE.
    Its inequality rows count only if standing still violates them; the levels below may violate the others, and
    ``box_violation`` covers that for limits.

    Attributes:
        method: "classical" or "saturated" (static).
        damping: damping of each priority's motion: s / (s^2 + damping) replaces 1 / s; 0 allowed.
        curvature_damping: kappa, the factor of the damping for the second-order terms that the linear model omits,
            doubled for priorities below others; 0 for none. It vanishes where the tasks are met
            (``TaskRows.curvature``).
        potential_gain: alpha [rad^2/s]; 0 turns the potential off. It needs a ``ConfigurationLimit`` among the limits.
        margin: least distance of a joint to its limits in the potential, as a fraction of its range.
        rank_tolerance: rows outside the span of other rows by less than this fraction of the Frobenius norm of their
            level's weighted rows count as dependent.
        backend: choice of kernels, as in ``solve_nullspace`` (static).
    """

    method: NullSpaceMethod = eqx.field(default="classical", static=True, kw_only=True)
    damping: Float[Array, ""] = eqx.field(default=1e-8, converter=as_leaf("damping"))
    curvature_damping: Float[Array, ""] = eqx.field(default=1.0, converter=as_leaf("curvature_damping"), kw_only=True)
    potential_gain: Float[Array, ""] = eqx.field(default=0.01, converter=as_leaf("potential_gain"))
    margin: Float[Array, ""] = eqx.field(default=0.01, converter=as_leaf("margin"))
    rank_tolerance: Float[Array, ""] = eqx.field(default=1e-5, converter=as_leaf("rank_tolerance"))
    backend: Backend = eqx.field(default="auto", static=True, kw_only=True, converter=check_backend)

    def __check_init__(self):
        if self.method not in METHODS:
            raise OsikValueError(f"method is {self.method!r}; methods: {', '.join(METHODS)}")

    @property
    def saturates(self) -> bool:
        """Return whether joint limits are hard (``method="saturated"``)."""
        return self.method == "saturated"

    def solve(self, problem: VelocityProblem, warm_start: None = None) -> SchemeAnswer:
        """Return the velocity of one step."""
        constraints = problem.constraints()
        levels = problem.levels(constraints)
        descent = -self.potential_gain * limit_potential_gradient(
            problem.position, problem.position_lower, problem.position_upper, self.margin
        )
        answer = solve_nullspace(
            levels,
            *((problem.lower, problem.upper) if self.saturates else ()),
            secondary=descent,
            damping=problem.dampings(constraints, self.damping, self.curvature_damping),
            rank_tolerance=self.rank_tolerance,
            backend=self.backend,
        )
        status = answer.status
        if constraints is not None:
            status = status_with(constraints, status, answer.x, start=self._start(problem))
        first, count = levels[0].scaled(), jnp.asarray(len(levels), jnp.int32)
        if self.saturates:
            residual = _first_residual(first, answer, problem)
            return SchemeAnswer(answer.x, status, answer.iterations, count + answer.iterations, residual)
        gradient = first.matrix.T @ first.distance(answer.x)
        return SchemeAnswer(answer.x, status, count, count, jax.lax.stop_gradient(jnp.max(jnp.abs(gradient))))

    def _start(self, problem: VelocityProblem) -> Float[Array, " nv"]:
        """Return the starting velocity of the first level; inequality rows that hold there are inactive in it."""
        nowhere = jnp.zeros_like(problem.position)
        return clipped(nowhere, problem.lower, problem.upper) if self.saturates else nowhere


def _first_residual(first: Level, answer: NullSpaceSolution, problem: VelocityProblem) -> Float[Array, ""]:
    """Return the largest gradient entry, over joints that can move, of the first priority's unmet scaled motion."""
    start = clipped(jnp.zeros_like(answer.x), problem.lower, problem.upper)
    left = first.matrix @ (answer.x - start) + answer.scales[0] * first.distance(start)
    return jax.lax.stop_gradient(
        jnp.max(jnp.abs(jnp.where(problem.lower == problem.upper, 0.0, first.matrix.T @ left)))
    )


def limit_potential_gradient(
    position: Float[Array, " nv"],
    lower: Float[Array, " nv"],
    upper: Float[Array, " nv"],
    margin: Float[Array, ""] | float = 0.01,
) -> Float[Array, " nv"]:
    """Return df/dq of the joint-limit potential (eq. 8), 0 for joints without two finite limits or a range.

    r_i (2 q_i - u_i - l_i) / (2 n (u_i - q_i)^2 (q_i - l_i)^2): negative near the lower limit, positive near the upper,
    so that descending it leads away from both. q is clamped ``margin`` of the range inside the limits, where the
    potential is finite. (nv,)
    """
    narrow = NARROW_RANGE * EPSILON * jnp.maximum(jnp.abs(lower), jnp.abs(upper))
    limited = jnp.isfinite(lower) & jnp.isfinite(upper) & (upper - lower > narrow)
    low, high = jnp.where(limited, lower, -1.0), jnp.where(limited, upper, 1.0)
    span = high - low
    q = jnp.clip(position, low + margin * span, high - margin * span)
    count = jnp.maximum(jnp.sum(limited), 1)
    # in single precision the margin of a narrow range may be rounded away
    held = (margin > 0.0) & ((low + margin * span == low) | (high - margin * span == high))
    square = jnp.where(held, 1.0, (high - q) ** 2 * (q - low) ** 2)
    return jnp.where(limited & ~held, span * (2.0 * q - high - low) / (2.0 * count * square), 0.0)
