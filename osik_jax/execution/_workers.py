"""Workers of XLA's CPU pool, and where too few of them can wait for ever.

The condition, as read from jaxlib 0.10.2: a batched LAPACK call (Cholesky, QR, triangular solve, LU, SVD, eigenvalues)
whose batch times the operations for one matrix is at least 200,000 is split into tasks for the pool, and waits for them
in the thread that runs it, which is itself a worker where operations that do not depend on each other run at once. When
as many such calls wait as there are workers, no worker is left for their tasks, and the program never ends. Single
problems, small batches and a pool of one worker are not split and cannot wait.
"""

from __future__ import annotations

import os

from .._errors import warn
from ._backends import cpu_is_default

ENOUGH = 8
"""Workers: one more than batched factorisations are likely to run at once."""


def cores() -> int:
    """Return the number of cores that this process may use: XLA takes as many workers unless it is told otherwise."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def warn_of_few_workers() -> None:
    """Warn, once, where a batch is about to be solved by a pool whose size nobody has chosen."""
    global _warned
    if _warned or "PJRT_NPROC" in os.environ or not 1 < cores() < ENOUGH or not cpu_is_default():
        return
    _warned = True
    warn(
        f"a batch on a CPU of {cores()} cores: jaxlib's batched factorisations wait for workers inside workers, and "
        "several in one program can wait for ever; call osik_jax.runtime.configure_cpu() first, before any robot is "
        "loaded, or set PJRT_NPROC"
    )


_warned = False
