"""Local minima of a sum of squared errors in a box, by Newton's method.

Levenberg-Marquardt steps neglect the curvature of the kinematics, which an error that stays multiplies. They then creep
towards the optimum. Newton's method with the exact Hessian takes some ten steps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._linear import solve_positive, solve_with_pivots

_MOST = 60
"""Steps of one start."""
_LONGEST = 1.0
"""Longest step of a coordinate [rad or m]."""
_DAMPING = 1e-3
"""Damping of the first step, relative to the largest entry of the Hessian's diagonal. Steps with more prove nothing."""
# keeps the Hessian regular where the errors leave a joint free
_LEAST_DAMPING = 1e-9
_LESS, _MORE = 0.1, 6.0
"""Factors of the damping after a step that lowers the cost, and after one that does not."""
_GIVEN_UP = 1e6
"""Relative damping at which rounding hides what a step gains."""
_PIVOT = 1e-12
"""A matrix with a pivot below this, relative to its largest diagonal entry, counts as not positive definite."""

Model = Callable[
    [Float[Array, "n lanes"]], tuple[Float[Array, "m lanes"], Float[Array, "m n lanes"], Float[Array, "n n lanes"]]
]
"""Errors, their Jacobian, and their second derivatives weighted by them: what the Hessian has beside J'J."""


class Minimum(NamedTuple):
    """Local minima."""

    x: Float[Array, "n lanes"]  # coordinates
    cost: Float[Array, " lanes"]  # half the sum of the squared errors
    steps: Int[Array, " lanes"]  # that were taken


class _State(NamedTuple):
    """Best configuration of a lane with its quadratic model, and a trial configuration."""

    x: Float[Array, "n lanes"]
    cost: Float[Array, " lanes"]
    model: tuple[Array, Array, Array]
    trial: Float[Array, "n lanes"]
    promised: Float[Array, " lanes"]
    damping: Float[Array, " lanes"]
    open_: Bool[Array, " lanes"]
    steps: Int[Array, " lanes"]


def minimum(
    model: Model,
    x: Float[Array, "n lanes"],
    lower: Float[Array, "n _"],
    upper: Float[Array, "n _"],
    open_: Bool[Array, " lanes"],
    gain: Float[Array, "*lanes"],
) -> Minimum:
    """Descend from each start to a local minimum within the box, whose ends are infinite where free.

    Args:
        open_: lanes to work on; the others stay where they are.
        gain: a lane ends where a step promises to lower the length of the errors by less.
    """

    def goes_on(state: _State) -> Array:
        return (state.open_ & (state.steps < _MOST)).any()

    def body(state: _State) -> _State:
        return _step(model, lower, upper, gain, state)

    lanes = x.shape[1]
    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(model, x))
    unknown = jnp.full(lanes, jnp.inf, x.dtype)
    # the first trial is the start itself, which counts as a success and lowers the damping
    damping = jnp.full(lanes, _DAMPING / _LESS, x.dtype)
    end = jax.lax.while_loop(
        goes_on, body, _State(x, unknown, nothing, x, unknown, damping, open_, jnp.zeros(lanes, jnp.int32))
    )
    return Minimum(end.x, end.cost, end.steps)


def _step(model: Model, lower: Array, upper: Array, gain: Array, state: _State) -> _State:
    """Accept each lane's trial if it lowers the cost, else raise its damping; make the next trial."""
    new = model(state.trial)
    cost = 0.5 * jnp.sum(new[0] ** 2, 0)
    better = state.open_ & (cost < state.cost)
    x, lowest, (error, matrix, curvature) = jax.tree.map(
        lambda a, b: jnp.where(better, a, b), (state.trial, cost, new), (state.x, state.cost, state.model)
    )
    # a small step counts as the end only if damping did not make it small
    settled = (state.promised <= gain * jnp.sqrt(2.0 * lowest)) & (state.damping <= _DAMPING)
    damping = jnp.maximum(state.damping * jnp.where(better, _LESS, _MORE), _LEAST_DAMPING)
    gradient = jnp.sum(matrix * error[:, None], 0)
    free = ~(((x <= lower) & (gradient > 0.0)) | ((x >= upper) & (gradient < 0.0)))
    gradient, kept = jnp.where(free, gradient, 0.0), jnp.where(free, matrix, 0.0)
    move = _move(gradient, kept, jnp.where(free & free[:, None], curvature, 0.0), damping)
    trial = jnp.clip(x + move, lower, upper)
    return _State(
        # the last step is taken unseen: it is shorter than the one before, whose gain was hardly any
        x=jnp.where(state.open_ & settled, trial, x),
        cost=lowest,
        model=(error, matrix, curvature),
        trial=trial,
        promised=-0.5 * jnp.sum(gradient * move, 0),
        damping=damping,
        open_=state.open_ & ~settled & (damping < _GIVEN_UP),
        steps=state.steps + state.open_,
    )


def inverse_hessian(
    matrix: Float[Array, "m n"], curvature: Float[Array, "n n"], free: Bool[Array, " n"]
) -> Float[Array, "n n"]:
    """Return the pseudo-inverse of the Hessian over the free coordinates; 0 in rows and columns of the others.

    ``matrix`` and ``curvature``: as a ``Model`` returns them.
    """
    times = partial(jnp.matmul, precision="highest")
    hessian = jnp.where(free & free[:, None], times(matrix.T, matrix) + curvature, 0.0)
    one, kind = jnp.eye(len(free), dtype=matrix.dtype), jnp.finfo(matrix.dtype)
    # H (H^2 + ridge)^-1 takes directions without curvature for free, where 1 / (H + ridge) would multiply rounding
    ridge = jnp.maximum(kind.eps ** (1.0 / 3.0) * jnp.max(jnp.abs(hessian)), kind.tiny**0.25) ** 2
    squares = times(hessian, hessian) + ridge * one
    lanes = jnp.broadcast_to(squares[..., None], (*one.shape, len(one)))
    first = inverse = solve_positive(lanes, hessian)
    for _ in range(2):  # takes away the share of the ridge where the Hessian is regular
        inverse = inverse + times(first, one - times(hessian, inverse))
    return inverse


def _move(
    gradient: Float[Array, "n lanes"],
    matrix: Float[Array, "m n lanes"],
    curvature: Float[Array, "n n lanes"],
    damping: Float[Array, " lanes"],
) -> Float[Array, "n lanes"]:
    """Return a damped Newton step, or a Gauss-Newton step if the damped Hessian is not positive definite."""
    squares = jnp.sum(matrix[:, :, None] * matrix[:, None], 0)
    scale = jnp.maximum(jnp.max(jnp.sum(matrix**2, 0), 0), jnp.finfo(gradient.dtype).tiny)
    ridged = squares + damping * scale * jnp.eye(len(gradient), dtype=gradient.dtype)[..., None]
    both = jnp.concatenate([ridged + curvature, ridged], -1)
    steps, pivots = solve_with_pivots(both, jnp.concatenate([gradient, gradient], -1))
    (newton, fallback), (pivot, _) = jnp.split(steps, 2, -1), jnp.split(pivots, 2)
    move = -jnp.where(pivot > _PIVOT * scale, newton, fallback)
    longest = jnp.max(jnp.abs(move), 0)
    return move * jnp.minimum(1.0, _LONGEST / jnp.where(longest > 0.0, longest, 1.0))
