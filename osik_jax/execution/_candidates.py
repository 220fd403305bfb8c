"""Candidates of a kernel first, then one search for the problems whose candidate fails its certificate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ._backends import CPU_KERNELS, on_platforms
from ._platform import cpu_is_default


class Candidates(NamedTuple):
    """Functions with which a solver uses one kernel. All take batches: arrays have a leading axis of problems.

    Attributes:
        certified: from the problems to the kernel's candidates, with a flag where the certificate holds.
        search_rest: from these and the problems to the answers; it searches where the flag is not set.
    """

    certified: Callable[..., Any]
    search_rest: Callable[..., Any]

    def answers(self, *problems: Any) -> Any:
        """Return the candidates where they are certified, the search's answers elsewhere."""
        return self.search_rest(self.certified(*problems), *problems)


def certified_or_searched(
    kernels: dict[str, Candidates],
    search: Callable[..., Any],
    *problems: Any,
    no_candidates: Callable[..., Any] | None = None,
) -> Any:
    """Solve a batch by the kernel of the platform and the search, or by the search alone.

    Where the only kernel is one for CPUs and JAX's default backend a CPU, the search is traced once for all platforms:
    on those without the kernel no candidate is certified, and it begins with ``no_candidates``. It may leave out what a
    kernel has tried, so that a program for such a platform is made quicker with ``backend="jax"``.

    Args:
        kernels: what a solver takes of each kernel, by backend; empty for the search alone.
        search: from the problems to their answers.
        problems: pytrees whose arrays have a leading axis.
        no_candidates: from the problems to what ``certified`` returns where nothing is; default: zeros.
    """
    if len(kernels) != 1 or not kernels.keys() <= CPU_KERNELS or not cpu_is_default():
        return on_platforms({name: kernel.answers for name, kernel in kernels.items()}, search, *problems)
    ((name, (certified, search_rest)),) = kernels.items()

    def zeros(*problems: Any) -> Any:
        return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(certified, *problems))

    return search_rest(on_platforms({name: certified}, no_candidates or zeros, *problems), *problems)
