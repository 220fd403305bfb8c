"""Losses and gradients of a loop on many independent scenarios."""

from __future__ import annotations

import inspect
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..batching._structure import Static, put_together, taken_apart
from ..numerics._arguments import check_count
from ..solvers import Status
from ._loop import Loop, Scenarios, run_one
from ._losses import LossFunction
from ._parameters import ParameterSpace


class Evaluation(eqx.Module):
    """Losses of a loop on scenarios; ``evaluate`` says what the fields are."""

    losses: Float[Array, " n"]
    kept: Bool[Array, " n"]

    @property
    def loss(self) -> Float[Array, ""]:
        """Return the mean over the kept scenarios; NaN if there are none."""
        return jnp.sum(jnp.where(self.kept, self.losses, 0.0)) / jnp.sum(self.kept)

    @property
    def dropped(self) -> Array:
        """Return the number of dropped scenarios."""
        return jnp.sum(~self.kept)


class Problem(eqx.Module):
    """Minimisation problem: a loss of a loop, and a space of parameters."""

    loss: LossFunction
    loop: Loop
    space: ParameterSpace

    def value(self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int) -> Evaluation:
        """Return losses at a vector of parameters."""
        return Evaluation(*jax.lax.map(partial(self._one, vector), scenarios, batch_size=chunk))

    def gradient(
        self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int
    ) -> tuple[Evaluation, Float[Array, " p"]]:
        """Return losses at a vector of parameters, and the gradient of their mean.

        Each scenario has a gradient of its own, so that one which is not finite is left out and spoils nothing.
        """
        own = partial(jax.value_and_grad(self._one, has_aux=True), vector)
        (losses, kept), gradients = jax.lax.map(own, scenarios, batch_size=chunk)
        kept = kept & jnp.isfinite(gradients).all(1)
        total = jnp.sum(jnp.where(kept[:, None], gradients, 0.0), 0)
        return Evaluation(losses, kept), total / jnp.maximum(jnp.sum(kept), 1)

    def _one(self, vector: Float[Array, " p"], scenario: Scenarios) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        return scenario_loss(self.loss, self.space.apply(self.loop, vector), scenario)


def scenario_loss(loss: LossFunction, loop: Loop, scenario: Scenarios) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Return the loss of one scenario, and whether it can be kept."""
    trajectory, own = run_one(loop, scenario)
    value = jnp.asarray(loss(trajectory, own))
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise OsikValueError(
            f"the loss returned shape {value.shape} of {value.dtype}; it is one number for a trajectory"
        )
    has_numbers = (trajectory.solution.status != Status.NUMERICAL_ERROR).all()
    return value, jnp.isfinite(value) & has_numbers


def evaluate(loss: LossFunction, loop: Loop, scenarios: Scenarios, *, chunk: int | None = None) -> Evaluation:
    """Return the losses of a loop on scenarios; compiled once for a loss and a structure.

    Args:
        loss: a function of a trajectory and a loop, a ready one or your own.
        loop: what is run.
        scenarios: the scenarios to run.
        chunk: scenarios that run at a time; see ``tune``.

    Returns:
        The losses.

        - ``losses``: of each scenario; of no meaning where it was dropped. (n,)
        - ``kept``: false where the loss is not finite, or a step failed on a NaN. (n,)
        - ``loss``: mean over those that were kept; NaN if there are none.
        - ``dropped``: number of dropped scenarios.

    Raises:
        KeyError, ValueError: scenarios that do not fit the loop.
        TypeError: a loss with other arguments.
    """
    check_loss(loss)
    numbers, static = taken_apart((loss, loop))
    return _evaluate(numbers, scenarios.fitted(loop), static=static, chunk=chunk_size(chunk, len(scenarios)))


@partial(jax.jit, static_argnames=("static", "chunk"))
def _evaluate(numbers: Any, scenarios: Scenarios, *, static: Static, chunk: int) -> Evaluation:
    loss, loop = put_together(numbers, static)
    return Evaluation(*jax.lax.map(partial(scenario_loss, loss, loop), scenarios, batch_size=chunk))


def check_loss(loss: Any) -> None:
    """Raise TypeError unless a loss can be called with a trajectory and a loop."""
    if not callable(loss):
        raise OsikTypeError(
            f"the loss is {loss!r}; it is a function of a trajectory and a loop, such as Tracking('hand')"
        )
    try:
        inspect.signature(loss).bind(None, None)
    except TypeError:
        raise OsikTypeError(f"the loss {loss!r} has to take two arguments: the trajectory and the loop") from None


def chunk_size(chunk: int | None, count: int) -> int:
    """Return the number of scenarios that run at a time: all on an accelerator, at most 64 on a CPU."""
    if chunk is None:
        return min(count, 64) if jax.default_backend() == "cpu" else count
    check_count("chunk", chunk)
    return min(chunk, count)
