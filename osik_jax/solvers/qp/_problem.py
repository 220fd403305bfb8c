"""The quadratic program and its answer, as pytrees."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._box import outside
from .._certificate import kkt_share
from .._dense import apply
from .._pivots import AT_LOWER, AT_UPPER, INACTIVE
from ._cost import LeastSquares, Quadratic

CERTIFIED = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-5}
"""The largest ``kkt_residual`` of an answer that is SOLVED, by the precision of the data."""
_NOUGHT = 100.0
"""Roundings of what the cost pulls at it; an answer that is no larger is 0."""


class QP(eqx.Module):
    """min cost(x) + 1/2 sum_i t_i^2 / compliance_i  over  lower <= [x; C x + t] <= upper.

    Attributes:
        cost: of x, strictly convex.
        rows: C; p may be 0. (p, n)
        compliance: of the rows; 0 for a hard row (t = 0), 1 / weight for one that gives way at that price. (p,)
        lower: lower bounds of x, then of the rows; -inf allowed. (n + p,)
        upper: upper bounds; inf allowed, equal to the lower for an equality. (n + p,)
        known: constraints that are equalities to the lower bound, whatever the upper is (static); None for none.
    """

    cost: Quadratic | LeastSquares
    rows: Float[Array, "p n"]
    compliance: Float[Array, " p"]
    lower: Float[Array, " n+p"]
    upper: Float[Array, " n+p"]
    known: tuple[bool, ...] | None = eqx.field(default=None, static=True)

    @property
    def equality(self) -> Bool[Array, " n_and_p"]:
        """Constraints that are known to be equalities, and those whose bounds are equal."""
        equal = self.lower == self.upper
        return equal if self.known is None else equal | np.array(self.known)


class QPSolution(eqx.Module):
    """Answer of a quadratic program.

    Attributes:
        x: inside its box exactly, whatever the status. SOLVED: the minimiser. INFEASIBLE: the least violation of the
            hard rows, and of those the least cost. MAX_ITERATIONS: a careful step downhill, no worse than zero clipped
            into the box, which NUMERICAL_ERROR has. (n,)
        status: a ``Status`` code.
        iterations: constraints added to or dropped from the active set.
        factorizations: systems factored: 1 where the warm start (or no active bound) was right, 2 after a search. A
            first try through the rows that comes to nothing is not counted.
        kkt_residual: without units, at most 1e-9 (1e-5 in float32) where SOLVED. The larger of two: the largest force
            that nothing holds, or multiplier of the wrong sign, as a share of the largest sum of absolute terms that
            pull at a variable; the largest violation of a row, as a share of its scale.
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


def active_targets(qp: QP, active: Int[Array, " n_and_p"]) -> Float[Array, " n_and_p"]:
    """The bound that each active constraint sits at, 0 for the others (never infinite)."""
    at_lower = (active != INACTIVE) & (active != AT_UPPER)
    return jnp.where(at_lower, qp.lower, 0.0) + jnp.where(active == AT_UPPER, qp.upper, 0.0)


def given_way(qp: QP, stiff: float) -> Float[Array, " p"]:
    """Compliances with which hard rows give way too: they bend the cost ``stiff`` times as much as it bends most."""
    soft = qp.compliance > 0.0
    price = jnp.where(soft, 1.0 / jnp.where(soft, qp.compliance, 1.0), 0.0)
    steepest = jnp.max(qp.cost.diagonal() + apply(qp.rows.T**2, price))
    length = jnp.sum(qp.rows**2, 1)
    own = jnp.where(length > 0.0, length, 1.0) / (stiff * jnp.where(steepest > 0.0, steepest, 1.0))
    return jnp.where(soft, qp.compliance, own)


def forces(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"]) -> Float[Array, " n"]:
    """What cost and rows pull at each variable with, none against another: rounding is a share of it."""
    return qp.cost.forces(x) + apply(jnp.abs(qp.rows).T, jnp.abs(y))


class Scales(NamedTuple):
    """Rounding in the values and multipliers of the constraints is this large, times a tolerance."""

    value: Float[Array, " m"]
    multiplier: Float[Array, " m"]


def scales_of(qp: QP, diagonal: Float[Array, " n"], x: Float[Array, " n"], y: Float[Array, " p"]) -> Scales:
    """Invariant to the units of the variables: each is measured by the root of its curvature, from H's diagonal.

    Where the constraints hold all of x at 0, its rounding is that of what the cost pulls at it.
    """
    root = jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0))
    pulled = jnp.abs(qp.cost.gradient(x)) / root**2
    nought = jnp.max(jnp.abs(x) * root) <= _NOUGHT * jnp.finfo(x.dtype).eps * jnp.max(pulled * root)
    size = jnp.where(nought, pulled, jnp.abs(x))
    reach = jnp.concatenate([1.0 / root, apply(jnp.abs(qp.rows), 1.0 / root)])
    span = jnp.concatenate([jnp.ones_like(x), jnp.sum(jnp.abs(qp.rows), 1)])
    floor = jnp.minimum(jnp.max(size * root) * reach, jnp.max(size) * span)
    values = jnp.concatenate([x, apply(qp.rows, x)])
    bounds = [jnp.where(jnp.isfinite(b), jnp.abs(b), jnp.inf) for b in (qp.lower, qp.upper)]
    nearest = jnp.minimum(*bounds)
    value = floor + jnp.abs(values) + jnp.where(jnp.isfinite(nearest), nearest, 0.0)
    pull = jnp.concatenate([1e-3 * apply(jnp.abs(qp.rows).T, jnp.abs(y)), jnp.zeros_like(y)])
    return Scales(value, value / jnp.maximum(reach, jnp.finfo(x.dtype).tiny) ** 2 + pull)


def kkt_residual(qp: QP, x: Float[Array, " n"], y: Float[Array, " p"], active: Int[Array, " n+p"]) -> Float[Array, ""]:
    """Largest violation of the optimality conditions, as a share: see ``QPSolution.kkt_residual``."""
    n = len(x)
    slope = qp.cost.gradient(x) - apply(qp.rows.T, y)
    held = active[:n] != INACTIVE
    pushed = jnp.concatenate([slope, y * jnp.max(jnp.abs(qp.rows), 1, initial=0.0)])
    wrong_sign = jnp.where(active == AT_LOWER, -pushed, jnp.where(active == AT_UPPER, pushed, 0.0))
    values = apply(qp.rows, x) + qp.compliance * y
    loose = jnp.where((active[n:] != INACTIVE) & (y != 0.0), values - active_targets(qp, active)[n:], 0.0)
    gap = jnp.maximum(jnp.abs(outside(values, qp.lower[n:], qp.upper[n:])), jnp.abs(loose))
    scale = scales_of(qp, qp.cost.diagonal(), x, y).value[n:]
    left = jnp.concatenate([jnp.where(held, 0.0, jnp.abs(slope)), wrong_sign])
    return kkt_share(left, forces(qp, x, y), gap, scale)
