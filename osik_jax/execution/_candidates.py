"""Candidates of a kernel, then one search for the problems whose candidate fails its certificate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ._backends import CPU_KERNELS, on_platforms
from ._platform import cpu_is_default
from ._rules import when_lowered


class Candidates(NamedTuple):
    """Functions with which a solver uses one kernel. All take batches: arrays have a leading axis of problems."""

    # function of the problems that returns the kernel's candidates, each with a flag: certified or not
    certified: Callable[..., Any]
    # function of these and the problems that returns answers of the same types; it searches for the other problems
    search_rest: Callable[..., Any]

    def answers(self, *problems: Any) -> Any:
        """Return certified candidates, and the search's answers for the other problems."""
        return self.search_rest(self.certified(*problems), *problems)


def certified_or_searched(kernels: dict[str, Candidates], search: Callable[..., Any], *problems: Any) -> Any:
    """Solve a batch by the kernel of the platform and the search, or by the search alone.

    If the only kernel is for CPUs and JAX's default backend is a CPU, one search is traced, for all platforms. On
    platforms without the kernel it begins with zeros that are not certified. ``kernels`` has the functions of each
    kernel by backend.
    """
    if len(kernels) != 1 or not kernels.keys() <= CPU_KERNELS or not cpu_is_default():
        return on_platforms({name: kernel.answers for name, kernel in kernels.items()}, search, *problems)
    ((name, (certified, search_rest)),) = kernels.items()

    def zeros(*problems: Any) -> Any:
        return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(certified, *problems))

    candidates = on_platforms({name: certified}, zeros, *problems)
    return when_lowered(search_rest, candidates, candidates, *problems)
