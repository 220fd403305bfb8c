"""Workers of XLA's CPU pool, and the condition under which too few of them wait for ever.

jaxlib 0.10 and 0.11.0 split a batched LAPACK call (Cholesky, QR, triangular solve, LU, SVD, eigenvalues) into tasks for
the pool if its batch size times the operations for one matrix is at least 200,000. The call waits for its tasks in the
thread that runs it, which may itself be a worker. If as many such calls wait as there are workers, no worker is left
for the tasks, and the program never ends. Single problems, small batches and a pool of one worker are not split. Other
releases split no call.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.metadata import version

from .._errors import warn
from ._platform import cpu_is_default

ENOUGH = 8
"""Workers: one more than batched factorisations are likely to run at once."""

_SPLITS = (0, 10), (0, 11, 1)
"""The first jaxlib that splits such calls, and the first that does not any more."""


def cores() -> int:
    """Return the number of cores that this process may use, which is XLA's default number of workers."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def jaxlib_version() -> tuple[int, ...]:
    """Return jaxlib's version as a tuple of integers."""
    return tuple(int(part) for part in version("jaxlib").split(".")[:3] if part.isdigit())


def too_few_workers() -> bool:
    """Return whether split LAPACK calls can wait for ever: the pool is small and its size was not chosen."""
    return "PJRT_NPROC" not in os.environ and 1 < cores() < ENOUGH and splits(jaxlib_version()) and cpu_is_default()


def splits(jaxlib: tuple[int, ...]) -> bool:
    """Return whether this jaxlib splits batched LAPACK calls into tasks for the pool."""
    first, after = _SPLITS
    return first <= jaxlib < after


@cache
def warn_of_few_workers() -> None:
    """Warn once that a batch is solved by too few workers."""
    warn(
        f"a batch on a CPU of {cores()} cores: this jaxlib's batched factorisations wait for workers inside workers, "
        "and several in one program can wait for ever; call osik_jax.runtime.configure_cpu() first, before any robot "
        "is loaded, or set PJRT_NPROC, or take a jaxlib that has no such calls: 0.9, or 0.11.1 and later"
    )
