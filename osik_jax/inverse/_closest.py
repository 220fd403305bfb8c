"""Configurations with the least error, for targets that no search has met."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_GROUPS = 16
"""Searches of a target that go on to a local optimum."""
_EQUAL = 0.01
"""Optima whose errors differ by less than this, relative to the position tolerance, are equally good."""


class Closest(NamedTuple):
    """Best local optimum of each target."""

    x: Float[Array, "targets n"]  # coordinates
    error: Float[Array, " targets"]  # length of all errors [m], where a radian counts as the tolerances' ratio
    seed: Int[Array, " targets"]  # number of the search that it began with
    steps: Int[Array, " targets"]  # that were taken to all of the target's optima


def closest(
    search: Any, goals: Any, x: Float[Array, "targets seeds n"], open_: Bool[Array, " targets"], *, near: bool
) -> Closest:
    """Continue from the most promising searches of each target to local optima, and return the best.

    The best overall would often be of one basin, that of the searches that converge fastest. So the searches form
    groups, and the best of each group goes on.

    Args:
        x: where each search has led.
        open_: targets that are not met; the others are left alone.
        near: of equally good optima, whether to take the nearest to the first configuration, not the first one.
    """
    targets, seeds, n = x.shape
    groups = min(_GROUPS, seeds)
    each = jax.tree.map(lambda a: jnp.repeat(a, seeds, 0), goals)
    cost = search.costs(x.reshape(-1, n), each).reshape(targets, seeds)
    cost = jnp.pad(cost, ((0, 0), (0, -seeds % groups)), constant_values=jnp.inf)
    taken = jnp.argmin(cost.reshape(targets, -1, groups), 1) * groups + jnp.arange(groups)
    start = jnp.take_along_axis(x, taken[:, :, None], 1).reshape(-1, n)
    lanes = jax.tree.map(lambda a: jnp.repeat(a, groups, 0), goals)
    end, error, steps = search.local_optima(start, lanes, jnp.repeat(open_, groups))
    ends, errors = end.reshape(targets, groups, n), error.reshape(targets, groups)
    # argmin would choose NaN
    errors = jnp.where(jnp.isnan(errors), jnp.inf, errors)
    equal = errors <= jnp.min(errors, 1, keepdims=True) + _EQUAL * search.tolerance[0]
    away = jax.vmap(jax.vmap(search.distance))(search.unwound(ends)) if near else jnp.arange(groups, dtype=x.dtype)
    best = jnp.argmin(jnp.where(equal, away, jnp.inf), 1)[:, None]
    return Closest(
        jnp.take_along_axis(ends, best[:, :, None], 1)[:, 0],
        jnp.take_along_axis(errors, best, 1)[:, 0],
        jnp.take_along_axis(taken, best, 1)[:, 0].astype(jnp.int32),
        jnp.sum(steps.reshape(targets, groups), 1, dtype=jnp.int32),
    )
