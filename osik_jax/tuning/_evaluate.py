"""A loop on many scenarios: losses and gradients, one scenario not disturbing another."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._structure import Static, put_together, taken_apart
from ..solvers import Status
from ._loop import Loop
from ._losses import LossFunction
from ._parameters import ParameterSpace
from ._scenarios import Scenarios, run_one


class Evaluation(eqx.Module):
    """What a loop costs on scenarios.

    Attributes:
        losses: of each; of no meaning where it was dropped. (n,)
        kept: false where the loss is not finite, or a tick failed on a NaN. (n,)
    """

    losses: Float[Array, " n"]
    kept: Bool[Array, " n"]

    @property
    def loss(self) -> Float[Array, ""]:
        """Mean over those that were kept; NaN if there are none."""
        return jnp.sum(jnp.where(self.kept, self.losses, 0.0)) / jnp.sum(self.kept)

    @property
    def dropped(self) -> Array:
        """How many were not kept."""
        return jnp.sum(~self.kept)


class Problem(eqx.Module):
    """What is minimised: a loss of a loop, over a space of parameters."""

    loss: LossFunction
    loop: Loop
    space: ParameterSpace

    def one(self, vector: Float[Array, " p"], scenario: Scenarios) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Loss of one scenario, and whether it can be kept."""
        value, kept = scenario_loss(self.loss, self.space.apply(self.loop, vector), scenario)
        return value, kept

    def value(self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int) -> Evaluation:
        """Losses at a vector of parameters."""
        return Evaluation(*in_chunks(partial(self.one, vector), scenarios, chunk))

    def slope(
        self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int
    ) -> tuple[Evaluation, Float[Array, " p"]]:
        """Losses at a vector of parameters, and the gradient of their mean.

        Each scenario has a gradient of its own, so that one which is not finite is left out and spoils nothing.
        """
        (losses, kept), slopes = in_chunks(
            lambda scenario: jax.value_and_grad(self.one, has_aux=True)(vector, scenario), scenarios, chunk
        )
        kept = kept & jnp.isfinite(slopes).all(1)
        total = jnp.sum(jnp.where(kept[:, None], slopes, 0.0), 0)
        return Evaluation(losses, kept), total / jnp.maximum(jnp.sum(kept), 1)


def scenario_loss(loss: LossFunction, loop: Loop, scenario: Scenarios) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Loss of one scenario, and whether it can be kept."""
    trajectory, own = run_one(loop, scenario)
    value = jnp.asarray(loss(trajectory, own))
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(f"the loss returned shape {value.shape} of {value.dtype}; it is one number for a trajectory")
    sound = (trajectory.solution.status != Status.NUMERICAL_ERROR).all()
    return value, jnp.isfinite(value) & sound


def in_chunks(function: Callable[[Any], Any], batch: Any, chunk: int) -> Any:
    """``vmap(function)(batch)``, some lanes at a time; what the last chunk lacks is filled up with its first lane."""
    count = jax.tree.leaves(batch)[0].shape[0]
    if chunk >= count:
        return jax.vmap(function)(batch)
    blocks = -(-count // chunk)
    places = jnp.arange(blocks * chunk)
    places = jnp.where(places < count, places, 0).reshape(blocks, chunk)
    out = jax.lax.map(lambda own: jax.vmap(function)(jax.tree.map(lambda a: a[own], batch)), places)
    return jax.tree.map(lambda a: a.reshape(blocks * chunk, *a.shape[2:])[:count], out)


def evaluate(loss: LossFunction, loop: Loop, scenarios: Scenarios, *, chunk: int | None = None) -> Evaluation:
    """What a loop costs on scenarios; compiled once for a loss and a structure.

    Args:
        loss: a function of a trajectory and a loop, a ready one or your own.
        loop: what is run.
        scenarios: what it is run on.
        chunk: scenarios that run at a time; see ``tune``.

    Raises:
        KeyError, ValueError: scenarios that do not fit the loop.
        TypeError: a loss that takes other arguments.
    """
    check_loss(loss)
    numbers, static = taken_apart((loss, loop))
    return _evaluate(numbers, scenarios.fitted(loop), static=static, chunk=chunk_size(chunk, len(scenarios)))


@partial(jax.jit, static_argnames=("static", "chunk"))
def _evaluate(numbers: Any, scenarios: Scenarios, *, static: Static, chunk: int) -> Evaluation:
    loss, loop = put_together(numbers, static)
    return Evaluation(*in_chunks(lambda scenario: scenario_loss(loss, loop, scenario), scenarios, chunk))


def check_loss(loss: Any) -> None:
    """Raises TypeError where a loss cannot be called with a trajectory and a loop."""
    if not callable(loss):
        raise TypeError(f"the loss is {loss!r}; it is a function of a trajectory and a loop, such as Tracking('hand')")
    try:
        inspect.signature(loss).bind(None, None)
    except TypeError:
        raise TypeError(f"the loss {loss!r} has to take two arguments: the trajectory and the loop") from None


def chunk_size(chunk: int | None, count: int) -> int:
    """How many scenarios run at a time: all on an accelerator, some on a CPU, whose cache holds no more."""
    if chunk is None:
        return min(count, 64) if jax.default_backend() == "cpu" else count
    if isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1:
        raise ValueError(f"chunk is {chunk!r}; it is how many scenarios run at a time")
    return min(chunk, count)
