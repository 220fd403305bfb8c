"""JAX functions on PyTorch tensors, with PyTorch's gradients (extra ``torch``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import torch

from .._errors import OsikTypeError, OsikValueError


def wrap(step: Callable[..., Any]) -> Callable[..., Any]:
    """Return a JAX function as a function of PyTorch tensors that autograd differentiates.

    Tensors and arrays share their memory (DLPack) where both are on the same device; a tensor that is not contiguous
    is copied. The function is compiled once for each shape, and its derivative once more. On CUDA, JAX waits for what
    PyTorch has queued on its current stream, and that stream waits for JAX; the host waits for neither.

    Gradients are those of ``jax.vjp``, of first order (``create_graph=True`` raises RuntimeError). Arguments may
    be pytrees (dicts, tuples, equinox modules). Leaves that are no tensors are constants.

    Args:
        step: a pure function of arrays, such as ``jax.vmap(lambda q, p: osik.solve(...).velocity)``.

    Returns:
        The function; results are tensors in the same pytree. Tensors of integers, such as a status, have no gradient.

    Raises:
        TypeError: ``step`` is not callable.
        ValueError: a float64 tensor while ``jax_enable_x64`` is off (when the function is called).
    """
    if not callable(step):
        raise OsikTypeError(f"step is a {type(step).__name__}; it is a function of arrays")
    bridge = _Bridge(step)

    def of_tensors(*args: Any) -> Any:
        return bridge.call(*jax.tree.flatten(args))

    return of_tensors


class _Bridge:
    """JAX function compiled for the leaves of its arguments, without and with the data for its derivative."""

    def __init__(self, step: Callable[..., Any]):
        def with_pullback(leaves: list[Any], tree: Any, moving: tuple[int, ...]) -> tuple[Any, Any]:
            def of_moving(*values: Any) -> tuple[list[Any], Any]:
                own = list(leaves)
                for place, value in zip(moving, values, strict=True):
                    own[place] = value
                results = jax.tree.map(jnp.asarray, step(*jax.tree.unflatten(tree, own)))
                return [leaf for leaf in jax.tree.leaves(results) if _is_float(leaf)], results

            _, pullback, results = jax.vjp(of_moving, *(leaves[place] for place in moving), has_aux=True)
            return results, pullback

        self.plain = jax.jit(step)
        self.with_pullback = jax.jit(with_pullback, static_argnums=(1, 2))
        self.pull = jax.jit(lambda pullback, rates: pullback(rates))

    def call(self, leaves: list[Any], tree: Any) -> Any:
        """Return the results as a pytree of tensors."""
        places = [place for place, leaf in enumerate(leaves) if isinstance(leaf, torch.Tensor)]
        tensors = [leaves[place] for place in places]
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            structure: list[Any] = []  # of the results, which `forward` adds
            results = _Step.apply(self, tree, leaves, places, structure, *tensors)
            return jax.tree.unflatten(structure[0], results)
        found, out = jax.tree.flatten(self.plain(*jax.tree.unflatten(tree, _with_arrays(leaves, places, tensors))))
        return jax.tree.unflatten(out, _to_torch(found, tensors))


class _Step(torch.autograd.Function):
    """The JAX function as a function of PyTorch's autograd."""

    @staticmethod
    def forward(
        ctx: Any, bridge: _Bridge, tree: Any, leaves: list[Any], places: list[int], out: list[Any], *tensors: Any
    ) -> tuple[torch.Tensor, ...]:
        ctx.bridge, ctx.needs = bridge, ctx.needs_input_grad[5:]
        moving = tuple(place for place, needed in zip(places, ctx.needs, strict=True) if needed)
        found, ctx.pullback = bridge.with_pullback(_with_arrays(leaves, places, tensors), tree, moving)
        arrays, structure = jax.tree.flatten(found)
        out.append(structure)
        results = tuple(_to_torch(arrays, tensors))
        ctx.mark_non_differentiable(*(result for result in results if not result.is_floating_point()))
        # Memory is shared with JAX: autograd has to notice where a tensor is changed in place before `backward`.
        ctx.save_for_backward(*tensors, *results)
        return results

    @staticmethod
    def backward(ctx: Any, *rates: Any) -> tuple[torch.Tensor | None, ...]:
        if torch.is_grad_enabled():  # by create_graph=True
            raise RuntimeError("a wrapped JAX function has first derivatives alone: leave create_graph=True out")
        results = ctx.saved_tensors[len(ctx.needs) :]
        real = [_to_jax(rate) for rate, result in zip(rates, results, strict=True) if result.is_floating_point()]
        found = iter(_to_torch(list(ctx.bridge.pull(ctx.pullback, real)), rates))
        return (None,) * 5 + tuple(next(found) if needed else None for needed in ctx.needs)


def _with_arrays(leaves: list[Any], places: Sequence[int], tensors: Sequence[torch.Tensor]) -> list[Any]:
    """Return the leaves with the tensors replaced by arrays."""
    arrays = list(leaves)
    for place, tensor in zip(places, tensors, strict=True):
        arrays[place] = _to_jax(tensor)
    return arrays


def _to_jax(tensor: torch.Tensor) -> jax.Array:
    """Return a tensor as an array with the same memory."""
    if tensor.dtype == torch.float64 and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise OsikValueError('a float64 tensor: jax.config.update("jax_enable_x64", True) first, or give float32')
    return jax.dlpack.from_dlpack(tensor.detach().contiguous())


def _to_torch(arrays: list[Any], given: Sequence[torch.Tensor] = ()) -> list[torch.Tensor]:
    """Return arrays as tensors with the same memory, ready on PyTorch's current stream.

    JAX gives an argument back that it did not change: a result with the memory of a given tensor is copied.
    """
    if any(array.platform() == "cpu" for array in arrays):
        jax.block_until_ready(arrays)  # a CPU has no stream that PyTorch could wait on
    taken = {tensor.data_ptr() for tensor in given}
    results = [torch.from_dlpack(array) for array in arrays]
    return [result.clone() if result.data_ptr() in taken else result for result in results]


def _is_float(array: Any) -> bool:
    return jnp.issubdtype(array.dtype, jnp.floating)
