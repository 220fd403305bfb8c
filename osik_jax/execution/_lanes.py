"""Batches of problems as explicit arrays of lanes, for code that stops early, branches or works in blocks.

Under plain ``vmap`` a ``while_loop`` selects its whole carry at every iteration, and a ``cond`` runs both branches.
Code that sees the lanes can skip a branch that no lane needs. On a CPU it processes a batch in blocks that stay in the
cache, and each block stops when its slowest lane is done.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Int

from .._errors import OsikTypeError
from ._blocks import BLOCK, first_axes_as_one, in_blocks
from ._lapack import lanes_in_one
from ._platform import cpu_is_default, is_symbolic
from ._workers import too_few_workers

FEW_ON_CPU, FEW = 4, 256
"""Lanes that are worked on together where most are done."""


def in_lanes(solve: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of one problem from a batched function, whose arrays have a leading axis, the lanes.

    ``vmap`` of it, however deeply nested, calls ``solve`` on all lanes (on a CPU: on blocks of them). It is not
    differentiable: stop gradients at its inputs.
    """
    return of_one_problem(lambda *args: in_blocks(solve, args, BLOCK), shares=False)


def of_one_problem(solve: Callable[..., Any], *, shares: bool) -> Callable[..., Any]:
    """Return a function of one problem from a batched function; ``vmap`` of it makes one axis of all lanes.

    ``shares``: the batched function takes arrays of length 1 where all lanes share an array; else they are copied.
    """

    @custom_vmap
    def lanes(*args: Any) -> Any:
        return no_lanes(solve, args) if lanes_of(args) == 0 else solve(*args)

    @lanes.def_vmap
    def _(axis_size: int, in_batched: list[Any], *args: Any) -> tuple[Any, Any]:
        inner = lanes_of(args, in_batched)

        def merged(a: jax.Array, batched: bool) -> jax.Array:
            if shares and not batched and len(a) == 1:
                return a
            return first_axes_as_one(jnp.broadcast_to(a, (axis_size, inner, *a.shape[1 + batched :])))

        out = lanes(*jax.tree.map(merged, args, tuple(in_batched)))
        out = jax.tree.map(lambda a: a.reshape(axis_size, inner, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    def one(*args: Any) -> Any:
        return jax.tree.map(lambda a: a[0], lanes(*jax.tree.map(lambda a: jnp.asarray(a)[None], args)))

    return one


def refuse_explicit_axes(args: Any) -> None:
    """Raise an error if an array is sharded over an explicit axis of a mesh, whose lanes no block can be cut from."""
    for a in jax.tree.leaves(args):
        # axes of type Auto are not part of an array's type
        spec = jax.typeof(a).sharding.spec if isinstance(a, jax.Array) else ()
        if axes := [str(axis) for axis in spec if axis is not None]:
            raise OsikTypeError(
                f"an array is sharded over the explicit mesh axis {', '.join(axes)}; osik_jax takes axes of type Auto. "
                "Make the mesh with axis_types=(jax.sharding.AxisType.Auto,), or wrap the function in "
                "jax.sharding.auto_axes under jax.set_mesh, or give arrays without a mesh to osik_jax.scaling.sharded"
            )


def lanes_of(args: Any, axes: Any = None) -> int:
    """Return the number of lanes of some arrays; the axis of an array that all lanes share has length 1.

    ``axes`` has the axis of lanes of each array, by default the first. Flags count as 0 and 1.
    """
    refuse_explicit_axes(args)
    leaves = jax.tree.leaves(args)
    counts = {a.shape[int(axis)] for a, axis in zip(leaves, jax.tree.leaves(axes) or [0] * len(leaves), strict=True)}
    symbolic = [count for count in counts if is_symbolic(count)]
    if symbolic:
        return symbolic[0]
    return 0 if 0 in counts else max(counts)


def no_lanes(solve: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Return the result of ``solve`` for a batch of 0 problems, from the shapes for one problem; it is not run."""
    one = jax.tree.map(lambda a: jax.ShapeDtypeStruct((1, *a.shape[1:]), a.dtype), args)
    return jax.tree.map(lambda a: jnp.zeros((0, *a.shape[1:]), a.dtype), jax.eval_shape(solve, *one))


def with_the_rest(state: Any, done: Bool[Array, " B"], again: Callable[[Array, Any], Any], block: int) -> Any:
    """Return the state of all lanes after ``again`` was applied to those that are not done, block by block.

    ``again`` takes the indices of the lanes of a block and the state of all lanes; it returns the new state of the
    block. A block that is not full is padded with the last lane.
    """
    lanes = len(done)
    if lanes == 1:  # XLA would see that every round of the loop has the same numbers, and go through it beforehand
        return jax.lax.cond(done[0], lambda: state, lambda: again(jnp.zeros(1, int), state))

    def body(carry: tuple[Any, Array]) -> tuple[Any, Array]:
        state, done = carry
        at = first_set(~done, block)
        end = again(jnp.minimum(at, lanes - 1), state)
        state = jax.tree.map(lambda all_, new: all_.at[at].set(new, mode="drop"), state, end)
        return state, done.at[at].set(True, mode="drop")

    return jax.lax.while_loop(lambda carry: ~jnp.all(carry[1]), body, (state, done))[0]


def first_set(flags: Bool[Array, " B"], size: int) -> Int[Array, " size"]:
    """Return the indices of the first flags that are set, padded with the number of flags.

    ``jnp.nonzero`` does not compile in double precision in a program whose default is single, from JAX 0.12 on.
    """
    slot = jnp.where(flags, jnp.cumsum(flags, dtype=jnp.int32) - 1, size)
    numbers = jax.lax.iota(jnp.int32, len(flags))
    return jnp.full(size, len(flags), jnp.int32).at[slot].set(numbers, mode="drop")


def with_a_few(
    data: Any, state: Any, done: Bool[Array, " B"], again: Callable[[Any, Any], Any], block: int | None = None
) -> Any:
    """Return the state as ``with_the_rest`` does, for a function of a block's data and state.

    A batch of at most ``block`` lanes is one block. The data do not change. The default ``block`` is a few lanes, for
    batches in which most lanes are done.
    """
    lanes = done.shape[0]
    if is_symbolic(lanes):
        return jax.lax.cond(jnp.all(done), lambda: state, lambda: choose(done, state, again(data, state)))
    block = (FEW_ON_CPU if cpu_is_default() else FEW) if block is None else block
    if lanes > 1 and too_few_workers():
        block = lanes_in_one(again, (data, state), min(block, lanes))

    def gathered(at: Array, state: Any) -> Any:
        return again(*jax.tree.map(lambda a: a[at], (data, state)))

    if lanes > block:
        return with_the_rest(state, done, gathered, block)
    return jax.lax.cond(jnp.all(done), lambda: state, lambda: choose(done, state, again(data, state)))


def choose(where: jax.Array, new: Any, old: Any) -> Any:
    """Return ``new`` in lanes whose flag is set, ``old`` in the others."""
    return jax.tree.map(lambda a, b: jnp.where(where.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)
