"""Settings of the CPU runtime that the library needs, made on import and before the first computation.

The first three leave alone what the user has set: ``PJRT_NPROC``, that flag in ``XLA_FLAGS``,
``OPENBLAS_NUM_THREADS``. The last is to be set back after the import.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import version

import jax
import threadpoolctl

_MINIMUM_WORKERS = 8
_UNTRIED_JAXLIB = (0, 13)  # the same bound as that of jax in pyproject.toml


def widen_cpu_pool() -> None:
    """Gives XLA's CPU client at least 8 workers.

    jaxlib's batched LAPACK kernels (QR, triangular solve, Cholesky; seen with 0.10.2) wait for their own tasks inside a
    worker of the pool that has to run them, so as many of them at once as there are workers wait for ever: on two
    cores, two independent factorisations in one batched program are enough. The solvers here run theirs one after
    another; this keeps derivatives and a caller's own code safe too. It has no effect once JAX has made its CPU
    client, so import this package before the first computation.
    """
    os.environ.setdefault("PJRT_NPROC", str(max(_MINIMUM_WORKERS, os.cpu_count() or 1)))


def one_operation_after_another() -> None:
    """Tells XLA's CPU compiler not to look for operations that could run at the same time.

    A tick is hundreds of operations of a microsecond; handing them to other threads costs more than it gains. Without
    that a tick of G1 took 124 instead of 194 us on one core (jaxlib 0.10.2), and batches as long as before. A flag that
    XLA does not know ends the process, so versions that it was not tried with are left as they are.
    """
    flags, flag = os.environ.get("XLA_FLAGS", ""), "xla_cpu_enable_concurrency_optimized_scheduler"
    if flag not in flags and tuple(map(int, version("jaxlib").split(".")[:2])) < _UNTRIED_JAXLIB:
        os.environ["XLA_FLAGS"] = f"{flags} --{flag}=false".strip()


def single_threaded_lapack() -> None:
    """Keeps SciPy's OpenBLAS, which jaxlib takes its LAPACK from, to one thread a call.

    Its own threads win nothing on matrices of 50 rows, and calls from several XLA workers queue for them: on two busy
    cores a batch of QPs took 20 times as long, and a tick of the weighted scheme 3 to 80 times. NumPy has an OpenBLAS
    of its own, which this does not touch.
    """
    if "OPENBLAS_NUM_THREADS" in os.environ:
        return
    linalg = import_module("scipy.linalg")  # loads it, so that it can be found
    home = os.path.dirname(os.path.realpath(linalg.__path__[0]))
    libraries = threadpoolctl.ThreadpoolController().select(internal_api="openblas")
    for library in libraries.lib_controllers:
        if library.filepath.startswith(home):  # in scipy/ or, beside it, scipy.libs/
            library.set_num_threads(1)


def run_where_called() -> None:
    """Runs programs of one CPU device in the thread that calls them.

    JAX would hand each to a thread of the pool and come back at once. Whoever closes a loop waits for the answer, and
    handing it over and back costs more than a small program: a tick of G1 took 82 instead of 114 us on one core, and
    182 instead of 387 where two cores were to choose from (jaxlib 0.10.2). Batches split over several devices run side
    by side as before.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


widen_cpu_pool()
one_operation_after_another()
single_threaded_lapack()
run_where_called()
