"""Functions with rules of their own: for the derivative, which survives loops, and for long batches.

Linearising a ``scan`` moves what does not change out of its body, and before jax 0.12 ``jax.custom_jvp`` does not come
through that: the body keeps the plain operations and forgets the rule. First derivatives are right, but the second ones
of a loop are then those of the plain operations, silently; for a solver whose search is cut off from differentiation,
that is 0. A primitive of its own keeps its rule. Python 3.11 has no jax from 0.11 on, so the primitive is needed for as
long as that Python is supported.

A primitive may also go through a batch in its own way. On a CPU, arrays of a thousand lanes do not stay in the cache
from one operation to the next; ``blocked`` runs all operations on some lanes, then on the next.

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
    """Return the arrays as they are, under the name ``FOUND``."""
    return jax.tree.map(lambda a: checkpoint_name(a, FOUND), tree)


def custom_jvp(function: Callable[..., Any]) -> Ruled:
    """Decorate as ``jax.custom_jvp`` does, functions of pytrees by position with inexact arrays as results.

    What is given by keyword is static; the rule is given it too.
    """
    return Ruled(function)


def blocked(size: int) -> Callable[[Callable[..., Any]], Ruled]:
    """Return the function as it is, which on a CPU takes this many lanes of a ``vmap`` at a time.

    Its derivatives run on all lanes at once: in blocks they would be somewhat faster, and compile much longer.
    """

    def decorate(function: Callable[..., Any]) -> Ruled:
        ruled = Ruled(function, block=size)
        ruled.defjvp(partial(jax.jvp, function))
        return ruled

    return decorate


class Ruled:
    """A function with a rule of its own for its derivative, to any order."""

    def __init__(self, function: Callable[..., Any], block: int | None = None) -> None:
        self.function, self.block = function, block
        update_wrapper(self, function)

    def defjvp(self, rule: Callable[..., tuple[Any, Any]]) -> Callable[..., tuple[Any, Any]]:
        """Set the rule: from primals and tangents, both tuples, to results and their tangents."""
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
    """Return a function of many lanes, some lanes at a time; arrays that all lanes share stay shared."""

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


def not_exported(tree: Any) -> Any:
    """Return the arrays as they are; a program for ``jax.export`` with them in it is refused when it is lowered.

    For arguments of kernels: their custom calls are known to this process alone.
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
