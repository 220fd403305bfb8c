"""Minimiser by a projected Newton method, where a guess of the active set was wrong.

A soft row makes the cost piecewise quadratic. So a problem with soft rows alone is constrained by its box only, and a
projected Newton method descends in the box from any start (D. P. Bertsekas, "Projected Newton methods for optimization
problems with simple constraints", SIAM J. Control and Optimization 20, 1982). Its factor is R of the QR factors of the
rows, whose condition number is the root of the Hessian's.

Hard rows are softened and corrected by their multipliers: the method of multipliers, or augmented Lagrangian
(D. P. Bertsekas, "Constrained Optimization and Lagrange Multiplier Methods", 1982). If they are infeasible, the
multipliers grow along a Farkas certificate, and x approaches the least violation.

The cost has a curvature of 1 along each variable (``in_units``).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...execution._double import first_smallest
from ...execution._lanes import choose
from ...numerics._constants import (
    AT_LOWER,
    AT_UPPER,
    COMPLIANCE_DECREASE,
    EQUALITY,
    FARKAS_MARGIN,
    FARKAS_RADIUS,
    FARKAS_ROUNDOFF,
    FEASIBLE_AT_ONCE,
    FEASIBLE_DECREASE,
    FULL_STEP_ROUNDOFF,
    INACTIVE,
    LARGEST_PENALTY,
    MAX_JOINT_RELEASES,
    MAX_STEPS,
    MAX_UPDATES,
    NEWTON_ROUNDOFF,
    PENALTY,
    SHORTEST_STEP,
    SLOW_DECREASE,
    SMALL_STEP,
    SMALLER_STEP,
    SMALLER_STEPS,
    STEP_LENGTHS,
    UNCHANGED,
    ZERO_GRADIENT,
)
from ...numerics._dense import apply
from .._box import minimum_along, violation
from ._problem import QP, constraint_scales, gradient_scale, softened_compliance


class NewtonState(NamedTuple):
    """Iterate of one problem."""

    x: Float[Array, " n"]
    multiplier: Float[Array, " p"]  # of the hard rows, as estimated so far
    compliance: Float[Array, " p"]  # of all rows; the hard ones are softened
    last_x: Float[Array, " n"]  # x at the last update of the multipliers
    updates: Int[Array, ""]  # of the multipliers
    iterations: Int[Array, ""]
    infeasibility: Float[Array, ""]  # violation of hard rows at the last update, in units of the tolerance
    searching: Bool[Array, ""]
    converged: Bool[Array, ""]
    infeasible: Bool[Array, ""]
    single_release: Bool[Array, ""]  # one bound is released at a time
    on_face: Bool[Array, ""]  # at the minimiser of its face, so that a bound may be released
    at_minimiser: Bool[Array, ""]  # for the present multipliers
    steps: Int[Array, ""]  # since the last update of the multipliers


class Linearisation(NamedTuple):
    """Multipliers, gradient and free variables at an iterate."""

    values: Float[Array, " p"]  # of the rows, shifted by their multipliers
    multipliers: Float[Array, " p"]
    gradient: Float[Array, " n"]
    free: Bool[Array, " n"]
    can_release: Bool[Array, ""]  # whether the gradient points away from an active bound


class NewtonResult(NamedTuple):
    """Final iterate of the method."""

    x: Float[Array, " n"]
    row_multipliers: Float[Array, " p"]
    active: Int[Array, " m"]
    determined: Int[Array, " m"]  # those of them whose multiplier is more than roundoff
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    infeasible: Bool[Array, ""]


def projected_newton(
    qp: QP,
    start: Float[Array, "B n"],
    iterations: Int[Array, " B"],
    feasibility_tol: Float[Array, ""],
    zero_multiplier: Float[Array, ""],
    max_iterations: int,
) -> NewtonResult:
    """Return the minimisers of a batch: every argument has a leading axis of problems.

    The start is clipped into the box. ``feasibility_tol`` is the violation of a hard row that counts as none, relative
    to its scale; ``zero_multiplier`` is that of a multiplier, relative to the gradient's terms; ``iterations`` are
    changes of the active set so far.
    """
    first = jax.vmap(_initial_state)(qp, start, iterations)

    def is_running(s: NewtonState) -> Bool[Array, ""]:
        return jnp.any(s.searching & (s.iterations < max_iterations))

    def body(s: NewtonState) -> NewtonState:
        improved = jax.vmap(partial(_iterate, feasibility_tol))
        return choose(s.searching & (s.iterations < max_iterations), improved(qp, s), s)

    return jax.vmap(partial(_result, zero_multiplier))(qp, jax.lax.while_loop(is_running, body, first))


def _initial_state(qp: QP, start: Float[Array, " n"], iterations: Int[Array, ""]) -> NewtonState:
    n = len(start)
    x = jnp.clip(start, qp.lower[:n], qp.upper[:n])
    zero = jnp.zeros_like(iterations)
    no = jnp.zeros((), bool)
    return NewtonState(
        x=x,
        multiplier=jnp.zeros_like(qp.compliance),
        compliance=softened_compliance(qp, PENALTY),
        last_x=x,
        updates=zero,
        iterations=iterations,
        infeasibility=jnp.asarray(jnp.inf, x.dtype),
        searching=~no,
        converged=no,
        infeasible=no,
        single_release=no,
        on_face=~no,
        at_minimiser=no,
        steps=zero,
    )


def _linearise(qp: QP, s: NewtonState) -> Linearisation:
    """Evaluate the augmented Lagrangian: y = -dist(C x - compliance multiplier) / compliance, grad cost - C'y."""
    n = len(s.x)
    lower, upper = _box(qp)
    # rows shifted by their multipliers: the penalty's gradient is then that of the augmented Lagrangian
    values = apply(qp.rows, s.x) - s.compliance * s.multiplier
    multipliers = -violation(values, qp.lower[n:], qp.upper[n:]) / s.compliance
    gradient = qp.cost.gradient(s.x) - apply(qp.rows.T, multipliers)
    at_bound = (s.x <= lower) | (s.x >= upper)
    # bounds whose multiplier has the wrong sign; one at a time, the one whose release lowers the cost most
    released = at_bound & (((s.x > lower) & (gradient > 0.0)) | ((s.x < upper) & (gradient < 0.0)))
    best = released & (jnp.arange(n) == first_smallest(-jnp.where(released, gradient**2, 0.0))) & s.on_face
    free = ~at_bound | jnp.where(s.single_release, best, released)
    return Linearisation(values, multipliers, gradient, free, released.any())


def _iterate(feasibility_tol: Float[Array, ""], qp: QP, s: NewtonState) -> NewtonState:
    """Take a projected Newton step; at a minimiser update the multipliers of the hard rows, or end."""
    at = _linearise(qp, s)
    updated, stepped = _update_multipliers(feasibility_tol, qp, s, at), _newton_iteration(qp, s, at)
    return jax.tree.map(partial(jnp.where, s.at_minimiser), updated, stepped)


def _newton_iteration(qp: QP, s: NewtonState, at: Linearisation) -> NewtonState:
    newton = _newton_step(qp, s, at)
    small = jnp.where(s.steps < SMALLER_STEPS, SMALLER_STEP, SMALL_STEP)
    is_small = jnp.max(jnp.abs(newton)) <= small * jnp.max(jnp.abs(s.x))
    roundoff = NEWTON_ROUNDOFF * gradient_scale(qp, s.x, at.multipliers)
    is_stationary = jnp.all(~at.free | (jnp.abs(at.gradient) <= roundoff))
    # three ways to stop: a Newton step of roundoff, a gradient of roundoff, a line search without descent
    step, descends, is_inside = _line_search(qp, s, at, newton)
    stops = is_small | is_stationary | ~descends
    # the minimiser: no step lowers the cost, and no bound can be released
    is_last = stops & (s.on_face | ~at.can_release) & (s.single_release | is_small | is_stationary)
    is_last |= s.steps >= MAX_STEPS
    step = jnp.where(is_small | (is_inside & ~descends), newton, jnp.where(descends, step, 0.0))
    return s._replace(
        x=_add_step(qp, s.x, step),
        iterations=s.iterations + 1,
        steps=s.steps + 1,
        single_release=s.single_release | (stops & ~is_last) | (s.steps >= MAX_JOINT_RELEASES),
        on_face=jnp.where(s.single_release, stops, is_small | is_stationary),
        at_minimiser=is_last,
    )


def _add_step(qp: QP, x: Float[Array, " n"], step: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return x + step clipped into the box; a bound within roundoff ahead is reached exactly."""
    lower, upper = _box(qp)
    new = jnp.clip(x + step, lower, upper)
    bound = jnp.where(step > 0.0, upper, lower)
    distance, roundoff = jnp.abs(new - bound), NEWTON_ROUNDOFF * (jnp.abs(bound) + jnp.abs(x))
    return jnp.where((step != 0.0) & jnp.isfinite(bound) & (distance <= roundoff), bound, new)


def _box(qp: QP) -> tuple[Array, Array]:
    n = qp.rows.shape[1]
    return qp.lower[:n], qp.upper[:n]


def _newton_step(qp: QP, s: NewtonState, at: Linearisation) -> Float[Array, " n"]:
    """Return the Newton step over the free variables, assuming that no row changes sides: -(R'R)^-1 gradient."""
    # R of [rows in the penalty / sqrt(compliance); R of the cost], over the free variables
    root = jnp.where(at.multipliers != 0.0, 1.0 / jnp.sqrt(s.compliance), 0.0)
    rows = jnp.concatenate([(root[:, None] * qp.rows) * at.free, qp.cost.square_root(at.free)])
    triangle = jnp.linalg.qr(_longest_first(rows), mode="r")
    downhill = jnp.where(at.free, -at.gradient, 0.0)
    half = jax.scipy.linalg.solve_triangular(triangle, downhill, trans=1)
    return jnp.where(at.free, jax.scipy.linalg.solve_triangular(triangle, half), 0.0)


def _longest_first(rows: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """Sort rows by length: Householder QR is then accurate for each row (A. J. Cox, N. J. Higham, 1998)."""
    order = jax.lax.iota(jnp.int32, len(rows))
    return rows[jax.lax.sort((-jnp.sum(rows**2, 1), order), num_keys=1)[1]]


def _line_search(
    qp: QP, s: NewtonState, at: Linearisation, newton: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Bool[Array, ""], Bool[Array, ""]]:
    """Return the step along Newton's direction with the lowest cost, by a projected line search.

    The direction is clipped into the box at many lengths, or followed to the first bound, or to its minimum before.
    Return that step, whether it lowers the cost or meets a bound, and whether the full Newton step stays in the box.
    """
    lower, upper = _box(qp)
    # the step length at which the first bound is met
    ahead = jnp.where(newton > 0.0, upper - s.x, lower - s.x)
    to_bound = jnp.min(jnp.where(newton != 0.0, ahead / jnp.where(newton != 0.0, newton, 1.0), jnp.inf))
    # geometrically decreasing step lengths, the minimum along the straight line, and the way to the first bound
    lengths = SHORTEST_STEP ** jnp.linspace(0.0, 1.0, STEP_LENGTHS)
    reach = jnp.clip(to_bound, 0.0, 1.0)
    lengths = jnp.where(s.single_release, reach, 1.0) * lengths
    # a softened hard row raises the slope so fast that the minimum lies just behind the point where the row meets its
    # bound, where halved lengths may never come
    n, along = len(newton), apply(qp.rows, newton)
    of_cost = jnp.dot(at.gradient, newton) + jnp.dot(at.multipliers, along)
    curvature = jnp.dot(newton, qp.cost.hessian_product(newton))
    ideal = minimum_along(at.values, along, qp.lower[n:], qp.upper[n:], 1.0 / s.compliance, of_cost, curvature)
    lengths = jnp.append(lengths, jnp.stack([jnp.minimum(ideal, reach), reach]))
    steps = jnp.clip(s.x + lengths[:, None] * newton, lower, upper) - s.x
    changes = jax.vmap(partial(_cost_change, qp, s, at))(steps)
    eps = float(jnp.finfo(s.x.dtype).eps)
    roundoff = apply(jnp.abs(steps), gradient_scale(qp, s.x, at.multipliers)) * eps
    is_inside = to_bound >= 1.0
    is_full = is_inside & (lengths == 1.0)
    # the full step is preferred by a few units of roundoff
    best = first_smallest(changes - jnp.where(is_full, FULL_STEP_ROUNDOFF * roundoff, 0.0))
    descends = changes[best] < -roundoff[best]
    # a bound may be so near that the way to it changes nothing
    meets_bound = s.single_release & ~descends & ~is_inside & (to_bound > 0.0) & (changes[-1] <= roundoff[-1])
    best = jnp.where(meets_bound, len(lengths) - 1, best)
    return steps[best], descends | meets_bound, is_inside


def _cost_change(qp: QP, s: NewtonState, at: Linearisation, step: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the change of the augmented Lagrangian by gradient and curvature terms, without cancellation."""
    lower, upper = qp.lower[len(step) :], qp.upper[len(step) :]
    along, old = apply(qp.rows, step), violation(at.values, lower, upper)
    new = violation(at.values + along, lower, upper)
    change = jnp.where(old * new > 0.0, along, new - old)  # exact where the row stays on its side
    # of sum dist^2 / (2 compliance), without the part old along / compliance, which is in the gradient
    bend = jnp.sum((change**2 + 2.0 * old * (change - along)) / (2.0 * s.compliance))
    return jnp.dot(at.gradient, step) + 0.5 * jnp.dot(step, qp.cost.hessian_product(step)) + bend


def _update_multipliers(feasibility_tol: Float[Array, ""], qp: QP, s: NewtonState, at: Linearisation) -> NewtonState:
    """Update the multipliers of hard rows at a minimiser of the augmented Lagrangian, or end if they hold."""
    n = len(s.x)
    hard = qp.compliance == 0.0
    # how far hard rows are off, and off the points that their multipliers stand for
    values = apply(qp.rows, s.x)
    gap = jnp.where(hard, violation(values, qp.lower[n:], qp.upper[n:]), 0.0)
    off = jnp.where(hard, values - jnp.clip(at.values, qp.lower[n:], qp.upper[n:]), 0.0)
    tolerance = feasibility_tol * constraint_scales(qp, qp.cost.diagonal(), s.x, at.multipliers).value[n:]
    infeasibility = jnp.max(jnp.abs(off) / jnp.where(off == 0.0, 1.0, tolerance), initial=0.0)
    certified = is_farkas_certificate(qp.rows, gap / s.compliance, gap, s.x, *_box(qp)) & (infeasibility > 1.0)
    # feasible, far under the tolerance or where the updates have ceased to help
    ceased = infeasibility > FEASIBLE_DECREASE * s.infeasibility
    feasible = (infeasibility <= FEASIBLE_AT_ONCE) | ((infeasibility <= 1.0) & ceased)
    turns_infeasible = certified & ~s.infeasible
    unchanged = jnp.max(jnp.abs(s.x - s.last_x)) <= UNCHANGED * jnp.max(jnp.abs(s.x))
    is_least = _is_least_violation(qp, s.x, gap)
    is_last = s.updates + 1 >= MAX_UPDATES
    converged = jnp.where(s.infeasible, certified & ((unchanged & is_least) | is_last), feasible & ~turns_infeasible)
    # once infeasible, all hard rows get one compliance: x then goes to the least violation in the Euclidean norm
    equal = jnp.max(jnp.where(hard, s.compliance, 0.0), initial=0.0)
    # slow updates want a larger penalty, but not one that multipliers get their roundoff from
    may_grow = s.compliance > softened_compliance(qp, LARGEST_PENALTY)
    is_slow = may_grow & (infeasibility > jnp.maximum(SLOW_DECREASE * s.infeasibility, 1.0))
    is_slow = jnp.where(s.infeasible, unchanged & ~is_least, is_slow)
    reduced = jnp.where(is_slow, COMPLIANCE_DECREASE, 1.0) * s.compliance
    multiplier = jnp.where(converged, s.multiplier, 0.0)
    return s._replace(
        multiplier=jnp.where(hard & ~turns_infeasible & ~converged, at.multipliers, multiplier),
        compliance=jnp.where(hard, jnp.where(turns_infeasible, equal, reduced), s.compliance),
        last_x=s.x,
        updates=s.updates + 1,
        steps=jnp.zeros_like(s.steps),
        at_minimiser=jnp.zeros_like(s.at_minimiser),
        single_release=jnp.zeros_like(s.single_release),
        on_face=jnp.ones_like(s.on_face),
        infeasibility=infeasibility,
        searching=~converged & ~is_last,
        converged=converged,
        infeasible=s.infeasible | turns_infeasible,
    )


def _is_least_violation(qp: QP, x: Float[Array, " n"], gap: Float[Array, " p"]) -> Bool[Array, ""]:
    """Check that no direction in the box reduces the Euclidean norm of the violations (projected gradient).

    The gradient is 0 where the gaps are orthogonal to a variable's column of C. That is measured against the lengths of
    both: gaps of roundoff alone may be all that a column meets.
    """
    lower, upper = _box(qp)
    gradient = apply(qp.rows.T, gap)
    inward = jnp.where(x <= lower, -gradient, jnp.where(x >= upper, gradient, jnp.abs(gradient)))
    inward = jnp.where(lower == upper, 0.0, inward)
    return jnp.all(inward <= ZERO_GRADIENT * jnp.linalg.norm(qp.rows, axis=0) * jnp.linalg.norm(gap))


def _result(zero_multiplier: Float[Array, ""], qp: QP, s: NewtonState) -> NewtonResult:
    at = _linearise(qp, s)
    lower, _ = _box(qp)
    in_box = jnp.where(at.free, INACTIVE, jnp.where(s.x <= lower, AT_LOWER, AT_UPPER))
    labels = jnp.concatenate([in_box, jnp.sign(-at.multipliers).astype(jnp.int32)])
    in_gradient = jnp.concatenate([at.gradient, at.multipliers * jnp.max(jnp.abs(qp.rows), 1, initial=0.0)])
    counts = jnp.abs(in_gradient) > zero_multiplier * jnp.max(gradient_scale(qp, s.x, at.multipliers))
    hard = jnp.concatenate([jnp.ones(len(s.x), bool), qp.compliance == 0.0])
    active, determined = (
        jnp.where(qp.equality & (hard | (own != INACTIVE)), EQUALITY, own).astype(jnp.int32)
        for own in (labels, jnp.where(counts, labels, INACTIVE))
    )
    return NewtonResult(s.x, at.multipliers, active, determined, s.iterations, s.converged, s.infeasible)


def is_farkas_certificate(
    rows: Float[Array, "p n"],
    certificate: Float[Array, " p"],
    gap: Float[Array, " p"],
    x: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Check that a Farkas vector z proves that no point of the box satisfies the rows C.

    Where all rows hold at x + d, ``-z'C d`` is at least ``z'gap``; in the box it is at most the sum of |C'z|_j times
    the distance of x_j to its bound in the direction of -(C'z)_j. If the latter is smaller, there is no such d. Where a
    variable has no such bound, values up to a thousand times those at hand are considered. z has the sign of the gap in
    each row: the gaps themselves at the least violation. The gap is C x minus the nearest point of each row's interval,
    0 for rows that do not count; x is in the box.
    """
    # -z'C d as a linear function of d, whose coefficients below roundoff are 0
    gradient = apply(rows.T, certificate)
    roundoff = FARKAS_ROUNDOFF * apply(jnp.abs(rows).T, jnp.abs(certificate))
    gradient = jnp.where(jnp.abs(gradient) <= roundoff, 0.0, gradient)
    sizes = [jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0) for a in (x, lower, upper)]
    radius = FARKAS_RADIUS * jnp.max(jnp.stack(sizes), initial=0.0)
    # the most that this function reaches in the box: each variable at the bound that raises it
    distance = jnp.where(gradient > 0.0, x - lower, upper - x)
    largest_change = jnp.sum(jnp.abs(gradient) * jnp.where(jnp.isfinite(distance), distance, radius))
    return jnp.dot(certificate, gap) > (1.0 + FARKAS_MARGIN) * largest_change
