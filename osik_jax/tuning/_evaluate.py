"""Losses and gradients of a loop on many independent scenarios."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from .._errors import OsikTypeError, OsikValueError
from ..batching._structure import Static, put_together, taken_apart
from ..numerics._arguments import check_count
from ..scaling._sharded import moved
from ..solvers import Status
from ._loop import Loop
from ._losses import LossFunction
from ._parameters import ParameterSpace
from ._scenarios import Scenarios, run_one


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
    """Minimisation problem: a loss of a loop, a space of parameters, and the devices that share the scenarios."""

    loss: LossFunction
    loop: Loop
    space: ParameterSpace
    mesh: Mesh | None = eqx.field(static=True, default=None)

    def one(self, vector: Float[Array, " p"], scenario: Scenarios) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Return the loss of one scenario, and whether it can be kept."""
        return scenario_loss(self.loss, self.space.apply(self.loop, vector), scenario)

    def value(self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int) -> Evaluation:
        """Return losses at a vector of parameters."""
        numbers, static = taken_apart(self)

        def one(shared: Any, scenario: Scenarios) -> Any:
            return put_together(shared[0], static).one(shared[1], scenario)

        return Evaluation(*over_scenarios(one, (numbers, vector), scenarios, chunk, self.mesh))

    def gradient(
        self, vector: Float[Array, " p"], scenarios: Scenarios, chunk: int
    ) -> tuple[Evaluation, Float[Array, " p"]]:
        """Return losses at a vector of parameters, and the gradient of their mean.

        Each scenario has a gradient of its own, so that one which is not finite is left out and spoils nothing.
        """
        numbers, static = taken_apart(self)

        def one(shared: Any, scenario: Scenarios) -> Any:
            return jax.value_and_grad(put_together(shared[0], static).one, has_aux=True)(shared[1], scenario)

        (losses, kept), gradients = over_scenarios(one, (numbers, vector), scenarios, chunk, self.mesh)
        kept = kept & jnp.isfinite(gradients).all(1)
        total = jnp.sum(jnp.where(kept[:, None], gradients, 0.0), 0)
        return Evaluation(losses, kept), total / jnp.maximum(jnp.sum(kept), 1)


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


def over_scenarios(
    function: Callable[[Any, Any], Any], shared: Any, scenarios: Scenarios, chunk: int, mesh: Mesh | None
) -> Any:
    """Return ``function(shared, scenario)`` for each scenario, in chunks, split over the devices of a mesh.

    The scenarios are padded to a multiple of the devices with copies of the last one, which are cut off again.
    """
    if mesh is None:
        return in_chunks(partial(function, shared), scenarios, chunk)
    count = len(scenarios)
    whole = (
        scenarios[jnp.minimum(jnp.arange(count + -count % mesh.size), count - 1)] if count % mesh.size else scenarios
    )
    everywhere, split = PartitionSpec(), PartitionSpec(mesh.axis_names)
    # As in ``scaling.sharded``: loops inside the solvers begin with constants, which do not vary over the mesh.
    mapped = jax.shard_map(
        lambda shared, own: in_chunks(partial(function, shared), own, chunk),
        mesh=mesh,
        in_specs=(everywhere, split),
        out_specs=split,
        check_vma=False,
    )
    return jax.tree.map(lambda a: a[:count], mapped(shared, whole))


def shares(scenarios: Scenarios, mesh: Mesh | None) -> Scenarios:
    """Return the scenarios split over the devices of a mesh, or replicated if they do not divide evenly."""
    uneven = mesh is not None and len(scenarios) % mesh.size
    return _placed(scenarios, mesh, PartitionSpec() if mesh is None or uneven else PartitionSpec(mesh.axis_names))


def replicas(numbers: Any, mesh: Mesh | None) -> Any:
    """Return numbers replicated on all devices of a mesh; Python numbers stay, because they have no precision."""
    return _placed(numbers, mesh, PartitionSpec())


def replicated(results: Any, mesh: Mesh | None) -> Any:
    """Return the results of a program on all devices of a mesh, constants included."""
    return results if mesh is None else jax.lax.with_sharding_constraint(results, NamedSharding(mesh, PartitionSpec()))


def _placed(tree: Any, mesh: Mesh | None, spec: PartitionSpec) -> Any:
    if mesh is None:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    there = moved(leaves, [NamedSharding(mesh, spec)] * len(leaves))
    return eqx.combine(jax.tree.unflatten(structure, there), rest)


def in_chunks(function: Callable[[Any], Any], batch: Any, chunk: int) -> Any:
    """Return ``vmap(function)(batch)`` computed in chunks; the last chunk is padded with its first lane."""
    count = jax.tree.leaves(batch)[0].shape[0]
    if chunk >= count:
        return jax.vmap(function)(batch)
    blocks = -(-count // chunk)
    places = jnp.arange(blocks * chunk)
    places = jnp.where(places < count, places, 0).reshape(blocks, chunk)
    out = jax.lax.map(lambda own: jax.vmap(function)(jax.tree.map(lambda a: a[own], batch)), places)
    return jax.tree.map(lambda a: a.reshape(blocks * chunk, *a.shape[2:])[:count], out)


def evaluate(
    loss: LossFunction, loop: Loop, scenarios: Scenarios, *, chunk: int | None = None, mesh: Mesh | None = None
) -> Evaluation:
    """Return the losses of a loop on scenarios; compiled once for a loss and a structure.

    Args:
        loss: a function of a trajectory and a loop, a ready one or your own.
        loop: what is run.
        scenarios: the scenarios to run.
        chunk: scenarios that run at a time; see ``tune``.
        mesh: devices that the scenarios are split over; see ``tune``.

    Returns:
        The losses.

        - ``losses``: of each scenario; of no meaning where it was dropped. (n,)
        - ``kept``: false where the loss is not finite, or a step failed on a NaN. (n,)
        - ``loss``: mean over those that were kept; NaN if there are none.
        - ``dropped``: number of dropped scenarios.

    Raises:
        KeyError, ValueError: scenarios that do not fit the loop.
        TypeError: a loss with other arguments, or a mesh of another type.
    """
    check_loss(loss)
    check_mesh(mesh)
    numbers, static = taken_apart((loss, loop))
    numbers, own = replicas(numbers, mesh), shares(scenarios.fitted(loop), mesh)
    return _evaluate(numbers, own, static=static, chunk=chunk_size(chunk, len(scenarios), mesh), mesh=mesh)


@partial(jax.jit, static_argnames=("static", "chunk", "mesh"))
def _evaluate(numbers: Any, scenarios: Scenarios, *, static: Static, chunk: int, mesh: Mesh | None) -> Evaluation:
    def one(numbers: Any, scenario: Scenarios) -> Any:
        loss, loop = put_together(numbers, static)
        return scenario_loss(loss, loop, scenario)

    return Evaluation(*over_scenarios(one, numbers, scenarios, chunk, mesh))


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


def check_mesh(mesh: Any) -> None:
    """Raise TypeError unless the mesh is a ``jax.sharding.Mesh`` or None."""
    if mesh is not None and not isinstance(mesh, Mesh):
        raise OsikTypeError(f"mesh is {mesh!r}; it is a jax.sharding.Mesh of devices")


def chunk_size(chunk: int | None, count: int, mesh: Mesh | None = None) -> int:
    """Return the number of scenarios that run at a time on a device: all on an accelerator, at most 64 on a CPU."""
    count = -(-count // mesh.size) if mesh is not None else count
    if chunk is None:
        return min(count, 64) if jax.default_backend() == "cpu" else count
    check_count("chunk", chunk)
    return min(chunk, count)
