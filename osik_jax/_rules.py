"""Derivative rules that survive loops.

Linearising a ``scan`` moves what does not change out of its body, and ``jax.custom_jvp`` does not come through that
(seen with jax 0.10): the body keeps the plain operations and forgets the rule. First derivatives are right, but the
second ones of a loop are then those of the plain operations, silently; for a solver whose search is cut off from
differentiation, that is 0. A primitive of its own keeps its rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, update_wrapper
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir


def custom_jvp(function: Callable[..., Any]) -> Ruled:
    """As ``jax.custom_jvp``, for functions of pytrees of arrays by position, with inexact arrays as results."""
    return Ruled(function)


class Ruled:
    """A function with a rule of its own for its derivative, to any order."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        update_wrapper(self, function)

    def defjvp(self, rule: Callable[..., tuple[Any, Any]]) -> Callable[..., tuple[Any, Any]]:
        """Sets the rule: from primals and tangents, both tuples, to results and their tangents."""
        self.rule = rule
        return rule

    def __call__(self, *args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        body, shapes = jax.make_jaxpr(self.function, return_shape=True)(*args)
        results = _ruled.bind(*leaves, body=body, rule=self.rule, tree=tree, lanes=())
        return jax.tree.unflatten(jax.tree.structure(shapes), results)


_ruled = Primitive("ruled")
_ruled.multiple_results = True


def _run(*leaves: jax.Array, body: ClosedJaxpr, **_: Any) -> list[jax.Array]:
    return jaxpr_as_fun(body)(*leaves)


def _differentiate(
    leaves: Sequence[jax.Array],
    rates: Sequence[Any],
    *,
    body: ClosedJaxpr,
    rule: Callable[..., tuple[Any, Any]],
    tree: Any,
    lanes: tuple[tuple[int | None, ...], ...],
) -> tuple[list[jax.Array], list[jax.Array]]:
    inexact = [jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) for leaf in leaves]
    known = [ad.instantiate_zeros(rate) if moves else None for rate, moves in zip(rates, inexact, strict=True)]
    function = partial(_apply, rule, tree)
    for axes in lanes:
        moving = [axis if moves else None for axis, moves in zip(axes, inexact, strict=True)]
        function = jax.vmap(function, in_axes=(list(axes), moving))
    return function(list(leaves), known)


def _apply(rule: Callable[..., tuple[Any, Any]], tree: Any, leaves: list[Any], rates: list[Any]) -> Any:
    pairs = zip(leaves, rates, strict=True)
    rates = [np.zeros(jnp.shape(leaf), jax.dtypes.float0) if rate is None else rate for leaf, rate in pairs]
    results, moved = rule(tree.unflatten(leaves), tree.unflatten(rates))
    return jax.tree.leaves(results), jax.tree.leaves(moved)


def _batch(
    leaves: Sequence[jax.Array],
    axes: Sequence[int | None],
    *,
    body: ClosedJaxpr,
    lanes: tuple[tuple[int | None, ...], ...],
    **rest: Any,
) -> tuple[list[jax.Array], list[int]]:
    wider = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(body), in_axes=tuple(axes)))(*leaves)
    results = _ruled.bind(*leaves, body=wider, lanes=(*lanes, tuple(axes)), **rest)
    return results, [0] * len(results)


_ruled.def_impl(_run)
_ruled.def_abstract_eval(lambda *_, body, **__: body.out_avals)
mlir.register_lowering(_ruled, mlir.lower_fun(_run, multiple_results=True))
ad.primitive_jvps[_ruled] = _differentiate
batching.primitive_batchers[_ruled] = _batch
