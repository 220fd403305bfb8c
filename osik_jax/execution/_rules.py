"""Functions with their own rules for derivatives, which survive loops, and for long batches.

Linearising a ``scan`` moves constant parts out of its body. Before jax 0.12 ``jax.custom_jvp`` loses its rule there:
the body keeps the plain operations. First derivatives are right, but second derivatives of a loop are silently those of
the plain operations. For a solver whose search is not differentiated, they are 0. A primitive keeps its rule. Python
3.11 has no jax from 0.11 on, so the primitive is needed as long as that Python is supported.

A primitive can also process a batch in its own way. On a CPU, arrays of a thousand lanes do not stay in the cache
between operations; ``blocked`` runs all operations on one block of lanes after another.

This is the only file that uses ``jax.interpreters``, and a new release of jax breaks it first:
``tests/execution/test_rules.py`` takes each rule of the primitive through each transformation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, update_wrapper
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike

from .._errors import OsikValueError
from ._blocks import in_blocks

FOUND = "found by a search"
"""Name under which ``jax.checkpoint`` keeps what the reverse mode needs and only a search could compute anew."""


def found(tree: Any) -> Any:
    """Return the arrays unchanged, named ``FOUND`` for ``jax.checkpoint``."""
    return jax.tree.map(lambda a: checkpoint_name(a, FOUND), tree)


def custom_jvp(function: Callable[..., Any]) -> Ruled:
    """Decorate a function as ``jax.custom_jvp`` does: pytrees as positional arguments, float arrays as results.

    Keyword arguments are static, and the rule receives them too.
    """
    return Ruled(function)


def blocked(size: int) -> Callable[[Callable[..., Any]], Ruled]:
    """Return a decorator that makes a vmapped function run on a CPU in blocks of ``size`` lanes.

    Its derivatives run on all lanes at once: in blocks they would be somewhat faster, and compile much longer.
    """

    def decorate(function: Callable[..., Any]) -> Ruled:
        ruled = Ruled(function, block=size)
        ruled.defjvp(partial(jax.jvp, function))
        return ruled

    return decorate


class Ruled:
    """Function with its own derivative rule, to any order."""

    def __init__(self, function: Callable[..., Any], block: int | None = None) -> None:
        self.function, self.block = function, block
        update_wrapper(self, function)

    def defjvp(self, rule: Callable[..., tuple[Any, Any]]) -> Callable[..., tuple[Any, Any]]:
        """Set the rule: a function of primals and tangents (tuples) that returns results and their tangents."""
        self.rule = rule
        return rule

    def __call__(self, *args: Any, **options: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        function, rule = (partial(f, **options) if options else f for f in (self.function, self.rule))
        body, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        results = _ruled.bind(*leaves, body=body, rule=rule, tree=tree, lanes=(), block=self.block)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)


_ruled = Primitive("ruled")
_ruled.multiple_results = True


def _run(*leaves: ArrayLike, body: Any, **_: Any) -> list[ArrayLike]:
    return jaxpr_as_fun(body)(*leaves)


def _differentiate(
    leaves: Sequence[ArrayLike],
    rates: Sequence[Any],
    *,
    body: Any,
    rule: Callable[..., tuple[Any, Any]],
    tree: Any,
    lanes: tuple[tuple[int | None, ...], ...],
    block: int | None,
) -> tuple[list[ArrayLike], list[Any]]:
    inexact = [jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) for leaf in leaves]
    known = [ad.instantiate_zeros(rate) if moves else None for rate, moves in zip(rates, inexact, strict=True)]
    function = partial(_apply, rule, tree)
    for axes in lanes:
        moving = [axis if moves else None for axis, moves in zip(axes, inexact, strict=True)]
        function = jax.vmap(function, in_axes=(list(axes), moving))
    results, moved = function(list(leaves), known)
    return results, [
        ad.Zero(jax.typeof(r).to_tangent_aval()) if m is None else m for r, m in zip(results, moved, strict=True)
    ]


def _apply(rule: Callable[..., tuple[Any, Any]], tree: Any, leaves: list[Any], rates: list[Any]) -> Any:
    pairs = zip(leaves, rates, strict=True)
    rates = [np.zeros(jnp.shape(leaf), jax.dtypes.float0) if rate is None else rate for leaf, rate in pairs]
    results, moved = (jax.tree.leaves(out) for out in rule(tree.unflatten(leaves), tree.unflatten(rates)))
    return results, [None if jnp.result_type(m) == jax.dtypes.float0 else m for m in moved]


def _batch(
    leaves: Sequence[ArrayLike],
    axes: Sequence[int | None],
    *,
    body: Any,
    lanes: tuple[tuple[int | None, ...], ...],
    block: int | None,
    **rest: Any,
) -> tuple[list[ArrayLike], list[int]]:
    axes = tuple(axes)
    wide = jax.vmap(jaxpr_as_fun(body), in_axes=axes)
    wider = jax.make_jaxpr(_in_blocks(wide, axes, block) if block else wide)(*leaves)
    results = _ruled.bind(*leaves, body=wider, lanes=(*lanes, axes), block=block, **rest)
    return results, [0] * len(results)


def _in_blocks(wide: Callable[..., Any], axes: tuple[int | None, ...], size: int) -> Callable[..., Any]:
    """Return the batched function computed in blocks of lanes; arrays that all lanes share stay shared."""

    def function(*leaves: ArrayLike) -> Any:
        own = {i: jnp.moveaxis(leaves[i], axis, 0) for i, axis in enumerate(axes) if axis is not None}

        def some(lanes: dict[int, jax.Array]) -> Any:
            turned = {i: jnp.moveaxis(lane, 0, axes[i] or 0) for i, lane in lanes.items()}
            return wide(*(turned.get(i, leaf) for i, leaf in enumerate(leaves)))

        return in_blocks(some, (own,), size)

    return function


_ruled.def_impl(_run)
_ruled.to_lojax = _run  # jax 0.12 expands some operations, as nonzero, before it compiles what is around them
_ruled.def_abstract_eval(lambda *_, body, **__: body.out_avals)
mlir.register_lowering(_ruled, mlir.lower_fun(_run, multiple_results=True))
ad.primitive_jvps[_ruled] = _differentiate
batching.primitive_batchers[_ruled] = _batch


def by_platform(kernels: dict[str, Callable[..., Any]], otherwise: Callable[..., Any], *args: Any) -> Any:
    """Return the result of the function of the platform that a program is lowered for, as ``lax.platform_dependent``.

    ``otherwise`` is for other platforms and is traced only if a program is lowered for one of them: half of the time
    until a first answer. It needs all arrays as arguments, and returns arrays of the same types as the kernels.
    ``kernels`` has functions by platform, at least one; ``args`` are pytrees of arrays.
    """
    traced = [jax.make_jaxpr(kernel, return_shape=True)(*args) for kernel in kernels.values()]
    bodies = tuple(body for body, _ in traced)
    results = _bind_late(otherwise, args, tuple(kernels), bodies, bodies[0].out_avals)
    return jax.tree.unflatten(jax.tree.structure(traced[0][1]), results)


def when_lowered(function: Callable[..., Any], like: Any, *args: Any) -> Any:
    """Return the function's result, traced only when the program is lowered; it is not differentiated.

    Batches and derivatives trace functions again and again, and lower one of these traces. The function needs all
    arrays as arguments, in pytrees; ``like`` has arrays with the shapes and types of its results.
    """
    leaves, tree = jax.tree.flatten(like)
    return jax.tree.unflatten(tree, _bind_late(function, args, (), (), tuple(map(_strong_type, leaves))))


def _strong_type(a: Any) -> Any:
    return jax.typeof(a).update(weak_type=False)


def _bind_late(function: Callable[..., Any], args: Any, platforms: Any, bodies: Any, types: Any) -> list[Any]:
    leaves, tree = jax.tree.flatten(args)
    doubles = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    def late(*leaves: ArrayLike) -> list[jax.Array]:
        with jax.enable_x64(doubles):
            results = [jnp.asarray(a) for a in jax.tree.leaves(function(*tree.unflatten(leaves)))]
        found, wanted = ([(a.shape, a.dtype) for a in arrays] for arrays in (results, types))
        if found != wanted:
            raise TypeError(f"a function traced late returns {found}; its program takes {wanted}")
        return results

    return _late.bind(*leaves, late=late, platforms=platforms, bodies=bodies, types=tuple(types))


_late = Primitive("late")
_late.multiple_results = True


def _lower_late(
    platform: str | None, context: Any, *operands: Any, late: Any, platforms: Any, bodies: Any, **_: Any
) -> Any:
    body = dict(zip(platforms, bodies, strict=True)).get(platform)
    function = late if body is None else jaxpr_as_fun(body)
    return mlir.lower_fun(function, multiple_results=True)(context, *operands)


def _batch_late(
    leaves: Sequence[ArrayLike], axes: Sequence[int | None], *, late: Any, platforms: Any, bodies: Any, types: Any
) -> tuple[list[ArrayLike], list[int]]:
    wide = [jax.vmap(f, in_axes=tuple(axes)) for f in (*map(jaxpr_as_fun, bodies), late)]
    if bodies:
        results = by_platform(dict(zip(platforms, wide, strict=False)), wide[-1], *leaves)
    else:
        size = next(jnp.shape(a)[axis] for a, axis in zip(leaves, axes, strict=True) if axis is not None)
        results = when_lowered(wide[-1], [jnp.zeros((size, *own.shape), own.dtype) for own in types], *leaves)
    return results, [0] * len(results)


_late.def_impl(lambda *leaves, **given: jax.jit(partial(_late.bind, **given))(*leaves))
_late.to_lojax = _late.bind
_late.def_abstract_eval(lambda *_, types, **__: types)
for _platform in ("cpu", "cuda", None):
    mlir.register_lowering(_late, partial(_lower_late, _platform), platform=_platform)
batching.primitive_batchers[_late] = _batch_late


def not_exported(tree: Any) -> Any:
    """Return the arrays unchanged; a program that contains them cannot be exported by ``jax.export``.

    For arguments of kernels, whose custom calls exist in this process alone.
    """
    return jax.tree.map(lambda a: _not_exported.bind(jnp.asarray(a)), tree)


def _lower_unless_exported(context: mlir.LoweringRuleContext, operand: Any) -> list[Any]:
    parameters = context.module_context.lowering_parameters
    if getattr(parameters, "for_export", False):
        raise OsikValueError(KERNEL_IN_EXPORT)
    return [operand]


KERNEL_IN_EXPORT = (
    "this program calls a compiled kernel of osik_jax, which is in this process alone, so jax.export cannot save it: "
    'make the scheme with backend="jax", such as WeightedQP(backend="jax"), and export the program again'
)
_not_exported = Primitive("not_exported")
_not_exported.def_impl(lambda operand: operand)
_not_exported.to_lojax = lambda operand: operand
_not_exported.def_abstract_eval(lambda operand: operand)
mlir.register_lowering(_not_exported, _lower_unless_exported)
batching.defvectorized(_not_exported)
