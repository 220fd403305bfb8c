"""Damped Gauss-Newton (Levenberg-Marquardt) with exact Jacobians, and weights of a robust loss."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Rows = tuple[Float[Array, "n k"], ...]
"""Differences of each measurement, divided by their standard deviations."""

LOSSES = ("squared", "huber", "cauchy", "geman_mcclure")
_TUNING = {"huber": 1.345, "cauchy": 2.385, "geman_mcclure": 3.787}
"""Lengths in standard deviations at which a loss has 95 % of the efficiency of least squares for normal noise."""
_MEDIANS = {1: 0.67449, 2: 1.17741, 3: 1.53817, 6: 2.31260}
"""Median of the length of k standard normal numbers."""
LEAST_SCALE = 1e-3
"""Least scale of the noise relative to the given one: more than half of exact readings would make it 0."""

_FIRST_DAMPING, _LEAST_DAMPING, _GREATEST_DAMPING = 1e-3, 1e-9, 1e9
"""Damping relative to the diagonal of the normal matrix. The least one is below what slows convergence down."""
_SHRINK, _GROW = 0.1, 10.0


class Loss(NamedTuple):
    """Weights of readings by their residuals."""

    name: str  # one of ``LOSSES``
    least_scale: float  # least scale of the noise relative to the given one
    unknowns: int  # how many there are: a fit to few readings makes their residuals smaller than the noise


class Fit(NamedTuple):
    """Result of a fit."""

    change: Float[Array, " p"]  # the unknowns
    rows: Rows  # differences over standard deviations at the end
    before: Rows  # those at the start
    jacobian: tuple[Float[Array, "n k p"], ...]  # of each measurement's rows at the end
    weights: tuple[Float[Array, " n"], ...]  # of each reading by the loss, 1 for least squares
    spread: tuple[Float[Array, ""], ...]  # of each measurement, the mean square of the weighted rows
    slope: tuple[Float[Array, ""], ...]  # of each measurement, the mean derivative of the weighted rows by the rows
    iterations: Int[Array, ""]  # how many were made
    converged: Bool[Array, ""]  # whether the last step was below the tolerance


class _State(NamedTuple):
    """State of the search: the best change so far with its rows, and the change that is tried next."""

    change: Float[Array, " p"]
    rows: Rows
    jacobian: tuple[Float[Array, "n k p"], ...]
    before: Rows
    candidate: Float[Array, " p"]
    damping: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def fit(
    rows_of: Callable[[Array], Rows],
    fixed_rows: Callable[[Array], Rows],
    precision: Float[Array, " p"],
    loss: Loss,
    limit: int,
) -> Fit:
    """Minimise the loss of the rows plus ``precision * change^2``, from no change.

    Args:
        rows_of: rows at a change, which carry derivatives by robot and readings.
        fixed_rows: the same without, for the search.
        precision: of the prior of each unknown, 1 / variance. (p,)
        loss: how readings are weighted.
        limit: greatest number of iterations.
    """
    start = jnp.zeros_like(precision)
    tolerance = float(jnp.finfo(start.dtype).eps) ** 0.5

    def advance(state: _State) -> _State:
        # one evaluation each time: the program holds the kinematics' derivatives once
        tried, first = _with_jacobian(fixed_rows, state.candidate), state.iterations == 0
        before = jax.tree.map(partial(jnp.where, first), tried[0], state.before)
        old = jax.tree.map(partial(jnp.where, first), tried[0], state.rows)
        weights = _weights(old, loss)
        cost = _cost(tried[0], weights, precision, state.candidate)
        better = first | (cost <= _cost(old, weights, precision, state.change))
        new, kept = (state.candidate, *tried), (state.change, old, state.jacobian)
        change, rows, jacobian = jax.tree.map(partial(jnp.where, better), new, kept)
        factor = jnp.where(first, 1.0, jnp.where(better, _SHRINK, _GROW))
        damping = jnp.clip(state.damping * factor, _LEAST_DAMPING, _GREATEST_DAMPING)
        step, length = _step(rows, jacobian, _weights(rows, loss), precision, change, damping)
        return _State(change, rows, jacobian, before, change + step, damping, state.iterations + 1, length < tolerance)

    def goes_on(state: _State) -> Bool[Array, ""]:
        return ~state.converged & (state.damping < _GREATEST_DAMPING) & (state.iterations < limit)

    rows, jacobian = jax.tree.map(
        lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(partial(_with_jacobian, fixed_rows), start)
    )
    damping = jnp.asarray(_FIRST_DAMPING, start.dtype)
    state = _State(start, rows, jacobian, rows, start, damping, jnp.asarray(0), jnp.asarray(False))
    last = jax.lax.while_loop(goes_on, advance, state)
    rows = rows_of(last.change)
    weights = _weights(rows, loss)
    # one more step carries the derivative
    step = _step(rows, last.jacobian, weights, precision, last.change, _LEAST_DAMPING)[0]
    change = last.change + jnp.where(jnp.isfinite(step), step, 0.0)  # of a reading that is NaN, in jit
    lengths = _lengths(rows, loss)
    spread = tuple((w**2 * (r**2).mean(-1)).mean() for w, r in zip(weights, rows, strict=True))
    slope = tuple(_slope(u, r.shape[1], loss.name) for u, r in zip(lengths, rows, strict=True))
    return Fit(change, rows, last.before, last.jacobian, weights, spread, slope, last.iterations, last.converged)


def _with_jacobian(rows_of: Callable[[Array], Rows], change: Array) -> tuple[Rows, tuple[Array, ...]]:
    """Return the rows and their exact Jacobian, in one pass of forward derivatives."""
    rows, push = jax.linearize(rows_of, change)
    columns = jax.vmap(push)(jnp.eye(len(change), dtype=change.dtype))
    return rows, tuple(jnp.moveaxis(column, 0, -1) for column in columns)


def normal_matrix(jacobian: tuple[Array, ...], weights: tuple[Array, ...]) -> Float[Array, "p p"]:
    """Return the sum of ``J' w J`` over all readings; a weight is a number or (n,)."""
    parts = (
        jnp.einsum("nkp,n,nkq->pq", j, jnp.broadcast_to(w, j.shape[:1]), j, precision="highest")
        for j, w in zip(jacobian, weights, strict=True)
    )
    return sum(parts)  # pyright: ignore[reportReturnType]


def _step(
    rows: Rows,
    jacobian: tuple[Array, ...],
    weights: tuple[Array, ...],
    precision: Array,
    change: Array,
    damping: Array | float,
) -> tuple[Array, Array]:
    """Return the damped step, and its length in standard deviations of the unknowns, one by one."""
    matrix = normal_matrix(jacobian, weights) + jnp.diag(precision)
    slope = precision * change
    for r, j, w in zip(rows, jacobian, weights, strict=True):
        slope = slope + jnp.einsum("nkp,n,nk->p", j, w, r, precision="highest")
    size = jnp.sqrt(jnp.diagonal(matrix))
    small = is_negligible(size)  # of an unknown that no row depends on but by roundoff, which stays
    size = jnp.where(small, jnp.inf, size)
    scaled = matrix / size / size[:, None] + damping * jnp.eye(len(size), dtype=size.dtype)
    step = -jax.scipy.linalg.solve(scaled, slope / size, assume_a="pos")
    return step / size, jnp.linalg.norm(step)


def is_negligible(size: Float[Array, " p"]) -> Bool[Array, " p"]:
    """Return which columns of a Jacobian are roundoff, by their lengths."""
    return size <= jnp.finfo(size.dtype).eps ** 0.5 * size.max()


def _cost(rows: Rows, weights: tuple[Array, ...], precision: Array, change: Array) -> Array:
    parts = ((w[:, None] * r**2).sum() for r, w in zip(rows, weights, strict=True))
    return sum(parts, (precision * change**2).sum())


def _lengths(rows: Rows, loss: Loss) -> tuple[Array, ...]:
    """Return the length of each reading's rows relative to its tuning length, with the scale of the noise by MAD."""
    if loss.name == "squared":
        return tuple(jnp.zeros(r.shape[0], r.dtype) for r in rows)
    count, found = sum(r.size for r in rows), []
    shrunk = (max(count - loss.unknowns, 1) / count) ** 0.5
    for r in rows:
        length = jnp.sqrt((r**2).sum(-1) + jnp.finfo(r.dtype).tiny)
        scale = jnp.maximum(jnp.median(length) / shrunk, loss.least_scale * _MEDIANS[r.shape[1]])
        found.append(length / scale * (_MEDIANS[1] / _TUNING[loss.name]))
    return tuple(found)


def _weight(u: Array, loss: str) -> Array:
    """Return the weight of a reading whose length is u tuning lengths."""
    if loss == "huber":
        return 1.0 / jnp.maximum(u, 1.0)
    return {"squared": jnp.ones_like(u), "cauchy": 1.0 / (1.0 + u**2), "geman_mcclure": 1.0 / (1.0 + u**2) ** 2}[loss]


def _weights(rows: Rows, loss: Loss) -> tuple[Array, ...]:
    return tuple(jax.lax.stop_gradient(_weight(u, loss.name)) for u in _lengths(rows, loss))


def _slope(u: Array, k: int, loss: str) -> Array:
    """Return the mean divergence of ``w(u) r`` by r, over k."""
    falls = jax.vmap(jax.grad(lambda one: _weight(one, loss)))(u)
    return (_weight(u, loss) + falls * u / k).mean()
