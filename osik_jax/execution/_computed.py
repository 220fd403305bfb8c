"""Functions with a kernel of the core that returns the same numbers as plain JAX.

There is no certificate: the kernel's answer equals that of the plain function up to rounding. The plain function runs
on other platforms and gives the derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core import _cuda, _library
from ._backends import on_platforms
from ._lanes import lanes_of, of_one_problem
from ._platform import cuda_is_default
from ._rules import custom_jvp


def by_kernel(plain: Callable[..., Any], kernel: Callable[..., Any], *, on_gpu: bool = True) -> Callable[..., Any]:
    """Return the plain function, computed by a kernel for batches where the core is; keyword arguments are static.

    ``kernel`` takes batches: arrays have a leading axis, of length 1 if all lanes share the array. Its first argument
    calls a method of the core: ``_library.call``, or on a GPU ``_cuda.call_lanes``.
    """

    @cache
    def anywhere(**options: Any) -> Callable[..., Any]:
        wide = over_lanes(partial(plain, **options))

        def everywhere(*args: Any) -> Any:
            calls: dict[str, Callable[..., Any]] = {"core": _library.call}
            if on_gpu and cuda_is_default() and _cuda.installed():
                calls["core-cuda"] = _cuda.call_lanes
            kernels = {name: partial(kernel, call, **options) for name, call in calls.items()}
            return on_platforms(kernels, wide, *args)

        return in_shared_lanes(everywhere)

    @custom_jvp
    def computed(*args: Any, **options: Any) -> Any:
        return anywhere(**options)(*args)

    @computed.defjvp
    def _(primals: tuple[Any, ...], tangents: tuple[Any, ...], **options: Any) -> tuple[Any, Any]:
        return jax.jvp(partial(plain, **options), primals, tangents)

    def function(*args: Any, **options: Any) -> Any:
        kinds = {jnp.result_type(a) for a in jax.tree.leaves(args)}
        usual = all(kind == jnp.result_type(float) for kind in kinds if jnp.issubdtype(kind, jnp.floating))
        # how precisions mix is the definition's to say
        return (computed if usual else plain)(*args, **options)

    return function


def in_shared_lanes(solve: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of one problem as ``in_lanes`` does, without blocks and without copies of shared arrays.

    Arrays that ``solve`` takes have a leading axis of lanes, or of length 1 if shared.
    """
    return of_one_problem(solve, shares=True)


def over_lanes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the batched function that ``in_shared_lanes`` takes, from a function of one lane."""

    def wide(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        lanes = lanes_of(leaves)
        own = [len(a) == lanes > 1 for a in leaves]
        rest = [a if many else a[0] for a, many in zip(leaves, own, strict=True)]

        def one(*leaves: jax.Array) -> Any:
            return function(*jax.tree.unflatten(tree, leaves))

        if lanes == 1:  # without an axis of length 1, XLA compiles fewer operations
            return jax.tree.map(lambda a: a[None], one(*rest))
        return jax.vmap(one, in_axes=[0 if many else None for many in own])(*rest)

    return wide


def side_by_side(*arrays: ArrayLike) -> Float[Array, "lanes k"]:
    """Return the numbers of several arrays concatenated for each lane, for arguments of ``in_shared_lanes``.

    Each argument of a kernel costs time, and an argument of constants alone is made once.
    """
    flat = [jnp.reshape(a, (len(a), -1)) for a in map(jnp.asarray, arrays)]
    lanes = lanes_of(flat)
    return jnp.concatenate([jnp.broadcast_to(a, (lanes, a.shape[1])) for a in flat], 1)
