"""Settings of the XLA runtime that the library needs, made before the first computation."""

from __future__ import annotations

import os

_WORKERS = "PJRT_NPROC"
_MINIMUM = 8


def widen_cpu_pool() -> None:
    """Gives XLA's CPU client at least 8 workers, unless ``PJRT_NPROC`` says otherwise.

    jaxlib's batched LAPACK kernels (QR, triangular solve, Cholesky; seen with 0.10.2) wait for their own tasks inside a
    worker of the pool that has to run them, so as many of them at once as there are workers wait for ever: on two
    cores, two independent factorisations in one batched program are enough. The solvers here run theirs one after
    another; this keeps derivatives and a caller's own code safe too. It has no effect once JAX has made its CPU
    client, so import this package before the first computation.
    """
    os.environ.setdefault(_WORKERS, str(max(_MINIMUM, os.cpu_count() or 1)))


widen_cpu_pool()
