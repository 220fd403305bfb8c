"""Pytrees of a quadratic program, its cost and its answer, and its optimality (KKT) conditions."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...execution._platform import cuda_is_default
from ...numerics._constants import (
    AT_LOWER,
    AT_UPPER,
    BOUND_MULTIPLIER,
    INACTIVE,
    INFEASIBLE_COMPLIANCE,
    QUADRATIC_RIDGE,
    ROW_MULTIPLIER,
    ZERO_TOL,
)
from ...numerics._dense import apply, product
from .._box import violation


class Quadratic(eqx.Module):
    """Cost 1/2 x'Hx + g'x."""

    matrix: Float[Array, "n n"]
    linear: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """Return H, (n, n)."""
        return self.matrix

    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of H, (n,)."""
        return jnp.diagonal(self.matrix)

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return H x + g, (n,)."""
        return apply(self.matrix, x) + self.linear

    def hessian_product(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return H x, (n,)."""
        return apply(self.matrix, x)

    def gradient_scale(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the sums of the gradient's absolute terms, which scale its roundoff, (n,)."""
        return apply(jnp.abs(self.matrix), jnp.abs(x)) + jnp.abs(self.linear)

    def square_root(self, free: Bool[Array, " n"]) -> Float[Array, "n n"]:
        """Return R with R'R = H over the free variables, identity rows for others (Cholesky with a small ridge)."""
        eps = QUADRATIC_RIDGE * float(jnp.finfo(self.matrix.dtype).eps)
        square = jnp.where(free[:, None] & free[None, :], self.matrix, 0.0)
        # relative to the largest diagonal element, so that a semidefinite H has a factor too
        ridge = jnp.where(free, eps * jnp.max(jnp.diagonal(square), initial=eps), 1.0)
        return jax.lax.linalg.cholesky(square + jnp.diag(ridge), symmetrize_input=False).T

    def curvature_bound(self) -> Float[Array, " n"]:
        """Return the diagonal of a matrix D >= H: row sums of |H| (Gershgorin), (n,)."""
        return jnp.sum(jnp.abs(self.matrix), 1)

    def in_units(self, unit: Float[Array, " n"]) -> Quadratic:
        """Return the cost of x / unit."""
        return Quadratic(self.matrix * unit[:, None] * unit, self.linear * unit)

    def has_valid_signs(self) -> Bool[Array, ""]:
        """Check that the diagonal of H is not negative."""
        return jnp.all(self.diagonal() >= 0.0)

    def placeholder(self) -> Quadratic:
        """Return a cost of the same shape that certainly has a minimiser."""
        return Quadratic(jnp.eye(len(self.linear), dtype=self.matrix.dtype), jnp.zeros_like(self.linear))


class LeastSquares(eqx.Module):
    """Cost 1/2 sum_i weight_i (A x - b)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2.

    Products go through A: what is lost to roundoff in H = A'WA (small weights beside large ones) is kept.
    """

    matrix: Float[Array, "m n"]
    target: Float[Array, " m"]
    weight: Float[Array, " m"]
    damping: Float[Array, " n"]
    center: Float[Array, " n"]

    def hessian(self) -> Float[Array, "n n"]:
        """Return A'WA + D, (n, n)."""
        return product(self.matrix.T * self.weight, self.matrix) + jnp.diag(self.damping)

    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of the Hessian, (n,)."""
        return apply(self.matrix.T**2, self.weight) + self.damping

    def gradient(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return A'W(A x - b) + D (x - c), (n,)."""
        residual = self.weight * (apply(self.matrix, x) - self.target)
        return apply(self.matrix.T, residual) + self.damping * (x - self.center)

    def hessian_product(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return (A'WA + D) x, (n,)."""
        return apply(self.matrix.T, self.weight * apply(self.matrix, x)) + self.damping * x

    def gradient_scale(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the sums of the gradient's absolute terms, which scale its roundoff, (n,)."""
        size = jnp.abs(self.matrix)
        # the terms that cancel in A x - b count one by one, and so do those of the damping
        residual_scale = self.weight * (apply(size, jnp.abs(x)) + jnp.abs(self.target))
        return apply(size.T, residual_scale) + self.damping * (jnp.abs(x) + jnp.abs(self.center))

    def square_root(self, free: Bool[Array, " n"]) -> Float[Array, "m_and_n n"]:
        """Return R with R'R = H over the free variables, identity rows for others: [sqrt(W) A; sqrt(D)]."""
        diagonal = jnp.where(free, jnp.sqrt(self.damping), 1.0)
        return jnp.concatenate([jnp.sqrt(self.weight)[:, None] * self.matrix * free, jnp.diag(diagonal)])

    def curvature_bound(self) -> Float[Array, " n"]:
        """Return the diagonal of a matrix that is no less than the Hessian: row sums of |A|'W|A| + D, (n,)."""
        # |x'A'WA x| <= sum_ij |x_i| (|A|'W|A|)_ij |x_j| <= sum_i (row sum)_i x_i^2
        size = jnp.abs(self.matrix)
        return apply(size.T, self.weight * jnp.sum(size, 1)) + self.damping

    def in_units(self, unit: Float[Array, " n"]) -> LeastSquares:
        """Return the cost of x / unit."""
        return LeastSquares(self.matrix * unit, self.target, self.weight, self.damping * unit**2, self.center / unit)

    def has_valid_signs(self) -> Bool[Array, ""]:
        """Check that weights and damping are not negative."""
        return jnp.all(self.weight >= 0.0) & jnp.all(self.damping >= 0.0)

    def placeholder(self) -> LeastSquares:
        """Return a cost of the same shape that certainly has a minimiser."""
        return LeastSquares(
            matrix=jnp.zeros_like(self.matrix),
            target=jnp.zeros_like(self.target),
            weight=jnp.zeros_like(self.weight),
            damping=jnp.ones_like(self.damping),
            center=jnp.zeros_like(self.center),
        )


class QP(eqx.Module):
    """Problem min cost(x) + 1/2 sum_i t_i^2 / compliance_i subject to lower <= [x; C x + t] <= upper."""

    cost: Quadratic | LeastSquares  # of x, strictly convex
    rows: Float[Array, "p n"]  # C; p may be 0
    compliance: Float[Array, " p"]  # of the rows; 0 for a hard row (t = 0), 1 / weight for a soft one
    lower: Float[Array, " n+p"]  # lower bounds of x, then of the rows; -inf allowed
    upper: Float[Array, " n+p"]  # upper bounds; inf allowed, equal to the lower for an equality
    # constraints that are equalities to the lower bound, whatever the upper is (static); None for none
    known_equalities: tuple[bool, ...] | None = eqx.field(default=None, static=True)

    @property
    def equality(self) -> Bool[Array, " n_and_p"]:
        """Return which constraints are equalities: those declared so, and those with equal bounds, (n + p,)."""
        equal = self.lower == self.upper
        return equal if self.known_equalities is None else equal | np.array(self.known_equalities)


class QPSolution(eqx.Module):
    """Answer of a quadratic program.

    Attributes:
        x: inside its box exactly, whatever the status. SOLVED: the minimiser. INFEASIBLE: the least violation of the
            hard rows, and of those the least cost. MAX_ITERATIONS: projected gradient steps, no worse than zero clipped
            into the box, which NUMERICAL_ERROR has. (n,)
        status: a ``Status`` code.
        iterations: constraints added to or dropped from the active set, or Newton steps in plain JAX.
        factorizations: systems factored: 1 where the warm start (or no active bound) was right; in plain JAX each
            Newton step factors one.
        kkt_residual: without units, at most 1e-9 (1e-5 in float32) where SOLVED. The larger of two: the largest
            gradient of the Lagrangian at a variable without an active bound, or multiplier of the wrong sign, relative
            to the largest sum of absolute terms of that gradient; the largest violation of a row, relative to its
            scale.
        slack: of the rows, C x minus the nearest point of its interval; 0 for a row that holds. (p,)
        multipliers: of the box: gradient of the cost = multipliers + C' row_multipliers; positive at a lower bound,
            negative at an upper. (n,)
        row_multipliers: of the rows, same signs. (p,)
        active: -1 at the lower bound, 1 at the upper, 2 equality, 0 free; of x, then of the rows. What
            ``warm_start`` takes. (n + p,)
    """

    x: Float[Array, " n"]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorizations: Int[Array, ""]
    kkt_residual: Float[Array, ""]
    slack: Float[Array, " p"]
    multipliers: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " n+p"]


def active_bounds(qp: QP, active: Int[Array, " n_and_p"]) -> Float[Array, " n_and_p"]:
    """Return the bound of each active constraint, 0 for inactive ones (never infinite)."""
    at_lower = (active != INACTIVE) & (active != AT_UPPER)
    return jnp.where(at_lower, qp.lower, 0.0) + jnp.where(active == AT_UPPER, qp.upper, 0.0)


def in_units(qp: QP, unit: Float[Array, " n"]) -> QP:
    """Return the problem in other units of the variables: of x / unit."""
    per_constraint = jnp.concatenate([unit, jnp.ones_like(qp.compliance)])
    bounds = qp.lower / per_constraint, qp.upper / per_constraint
    return QP(qp.cost.in_units(unit), qp.rows * unit, qp.compliance, bounds[0], bounds[1], qp.known_equalities)


def softened_compliance(qp: QP, penalty_ratio: float) -> Float[Array, " p"]:
    """Return compliances with hard rows made soft: curvature ``penalty_ratio`` times the largest one of the cost."""
    is_soft = qp.compliance > 0.0
    penalty = jnp.where(is_soft, 1.0 / jnp.where(is_soft, qp.compliance, 1.0), 0.0)
    largest_curvature = jnp.max(qp.cost.diagonal() + apply(qp.rows.T**2, penalty))
    square = jnp.sum(qp.rows**2, 1)
    # a row of length l and compliance c has the curvature l^2 / c along itself
    scaled = penalty_ratio * jnp.where(largest_curvature > 0.0, largest_curvature, 1.0)
    return jnp.where(is_soft, qp.compliance, jnp.where(square > 0.0, square, 1.0) / scaled)


def infeasible_compliance(qp: QP) -> Float[Array, " p"]:
    """Return the compliances with which the least violation of infeasible hard rows minimises the cost too."""
    largest = jnp.max(jnp.sum(qp.rows**2 / qp.cost.diagonal(), 1), initial=0.0)
    return jnp.maximum(INFEASIBLE_COMPLIANCE[largest.dtype] * largest, qp.compliance)


def compliance_of(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " p"]:
    """Return the compliances of rows that miss their bounds by their multipliers: that of the hard ones is the same."""
    n = len(x)
    gap = jnp.where(qp.compliance > 0.0, 0.0, jnp.abs(violation(apply(qp.rows, x), qp.lower[n:], qp.upper[n:])))
    largest = jnp.max(gap, initial=0.0)
    size = jnp.max(jnp.where(gap == largest, jnp.abs(y), 0.0), initial=0.0)
    return jnp.maximum(jnp.where(size > 0.0, largest / jnp.where(size > 0.0, size, 1.0), 0.0), qp.compliance)


def gradient_scale(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " n"]:
    """Return the sums of the absolute terms of the Lagrangian's gradient, which scale its roundoff."""
    return qp.cost.gradient_scale(x) + apply(jnp.abs(qp.rows).T, jnp.abs(y))


def multiplier_roundoff(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " n_and_p"]:
    """Return the roundoff of the multipliers.

    For the box it is the roundoff of the gradient. For a row it is the smallest multiplier that changes an entry of the
    gradient by its roundoff. A tolerance relative to the curvature is too large: with a weak damping beside heavy
    tasks, a smaller multiplier of the wrong sign moves x by as much as x itself.
    """
    scale = BOUND_MULTIPLIER[x.dtype] * float(jnp.finfo(x.dtype).eps) * gradient_scale(qp, x, y)
    size = jnp.abs(qp.rows)
    of_rows = jnp.where(size > 0.0, scale / jnp.where(size > 0.0, size, 1.0), jnp.inf)
    return jnp.concatenate([scale, jnp.min(of_rows, 1, initial=jnp.inf)])


class Scales(NamedTuple):
    """Magnitudes of the terms in values and multipliers of the constraints; times a tolerance they are roundoff."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


def constraint_scales(qp: QP, diagonal: Float[Array, " n"], x: Float[Array, " n"], y: Float[Array, " p"]) -> Scales:
    """Return scales independent of the variables' units: each variable is measured by the root of its curvature.

    Where the constraints hold all of x at 0, the Newton step of each variable alone takes the place of x.
    """
    root = jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0))
    newton = jnp.abs(qp.cost.gradient(x)) / root**2
    sizes = jnp.abs(x) * root, newton * root, jnp.abs(x), newton
    scaled, scaled_newton, plain, plain_newton = largest_of_each(*sizes)
    is_zero = scaled <= ZERO_TOL * jnp.finfo(x.dtype).eps * scaled_newton
    # what a constraint's value may be for such an x: in curvature units and in units of the variables, the smaller
    per_curvature = jnp.concatenate([1.0 / root, apply(jnp.abs(qp.rows), 1.0 / root)])
    per_unit = jnp.concatenate([jnp.ones_like(x), jnp.sum(jnp.abs(qp.rows), 1)])
    floor = jnp.minimum(
        jnp.where(is_zero, scaled_newton, scaled) * per_curvature, jnp.where(is_zero, plain_newton, plain) * per_unit
    )
    values = jnp.concatenate([x, apply(qp.rows, x)])
    bounds = [jnp.where(jnp.isfinite(b), jnp.abs(b), jnp.inf) for b in (qp.lower, qp.upper)]
    nearest = jnp.minimum(*bounds)
    value = floor + jnp.abs(values) + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    # the multiplier that moves the value by its scale, and a part of what the rows add to the gradient
    row_terms = jnp.concatenate([ROW_MULTIPLIER * apply(jnp.abs(qp.rows).T, jnp.abs(y)), jnp.zeros_like(y)])
    return Scales(value, value / jnp.maximum(per_curvature, jnp.finfo(x.dtype).tiny) ** 2 + row_terms)


def kkt_residual(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"], active: Int[Array, " n+p"]) -> Float[Array, ""]:
    """Return the largest violation of the optimality conditions, without units (``QPSolution.kkt_residual``).

    The conditions are stationarity, ``grad cost(x) - C'y = multipliers of the box``; signs of the multipliers;
    feasibility, and complementarity of the rows with a multiplier. x is inside its box; y are the multipliers of the
    rows, and those of the box follow from the gradient.
    """
    n = len(x)
    gradient = qp.cost.gradient(x) - apply(qp.rows.T, y)
    at_bound = active[:n] != INACTIVE
    # row multipliers in units of the gradient: times the largest entry of the row
    multipliers = jnp.concatenate([gradient, y * jnp.max(jnp.abs(qp.rows), 1, initial=0.0)])
    wrong_sign = jnp.where(active == AT_LOWER, -multipliers, jnp.where(active == AT_UPPER, multipliers, 0.0))
    values = apply(qp.rows, x) + qp.compliance * y
    off_bound = jnp.where((active[n:] != INACTIVE) & (y != 0.0), values - active_bounds(qp, active)[n:], 0.0)
    gap = jnp.maximum(jnp.abs(violation(values, qp.lower[n:], qp.upper[n:])), jnp.abs(off_bound))
    scale = constraint_scales(qp, qp.cost.diagonal(), x, y).value[n:]
    stationarity = jnp.maximum(jnp.where(at_bound, 0.0, jnp.abs(gradient)), wrong_sign[:n])
    return relative_kkt_residual(stationarity, gradient_scale(qp, x, y), wrong_sign[n:], gap, scale)


def relative_kkt_residual(
    stationarity: Float[Array, " n"],
    gradient_scale: Float[Array, " n"],
    wrong_sign: Float[Array, " p"],
    violation: Float[Array, " p"],
    violation_scale: Float[Array, " p"],
) -> Float[Array, ""]:
    """Return the KKT residual of a point without units, comparable between problems of any weights.

    It is the larger of two: the largest stationarity residual or wrong multiplier over the largest gradient scale, and
    the largest violation of a row over the size of its terms and bounds. ``stationarity`` has the gradient of the
    Lagrangian at variables without an active bound, and at the others multipliers of the wrong sign (not positive where
    the sign is right). A gradient scale is the sum of the gradient's absolute terms; ``wrong_sign`` is in units of the
    gradient.
    """
    residual, scale = largest_of_each(stationarity, gradient_scale)
    # stationarity and signs in units of the forces; feasibility in those of the rows' own terms
    dual = jnp.maximum(residual, jnp.max(wrong_sign, initial=0.0)) / jnp.where(scale > 0.0, scale, 1.0)
    relative = violation / jnp.where(violation_scale > 0.0, violation_scale, 1.0)
    primal = jnp.where(violation > 0.0, relative, 0.0)
    return jnp.maximum(dual, jnp.max(primal, initial=0.0))


def largest_of_each(*arrays: Float[Array, " n"]) -> list[Array]:
    """Return the largest entry of each array, at least 0: one operation for all, but on a GPU, where XLA's is slow."""
    if cuda_is_default():
        return [jnp.max(a, initial=0.0) for a in arrays]
    return list(jnp.max(jnp.stack(arrays), 1, initial=0.0))
