"""Settings of the CPU runtime for the whole process; an import makes none."""

from __future__ import annotations

import os
from importlib import import_module

import jax

from ..numerics._arguments import check_count
from ._workers import ENOUGH, cores, jaxlib_version

_UNTRIED_JAXLIB = (0, 13)  # the same bound as that of jax in pyproject.toml
_SCHEDULER = "xla_cpu_enable_concurrency_optimized_scheduler"
_ASYNCHRONOUS = "jax_cpu_enable_async_dispatch"


def configure_cpu(*, workers: int = ENOUGH) -> None:
    """Configure XLA's CPU runtime for small problems, for the whole process, before the first JAX computation.

    Call it once, in a program and not in a library. Your own settings stay: ``PJRT_NPROC``, flags in ``XLA_FLAGS``,
    ``OPENBLAS_NUM_THREADS``, ``JAX_CPU_ENABLE_ASYNC_DISPATCH``. Calling it again with the same argument does nothing.
    Answers do not depend on it. Without it one robot's control step takes longer, and on few cores two batches of
    factorisations in one program can wait for each other for ever.

    It sets the threads of XLA's pool, runs a program of one CPU device in its caller's thread, one operation after the
    other, and gives one thread to a LAPACK call of SciPy's OpenBLAS, which jaxlib uses; NumPy has its own.

    Args:
        workers: least number of threads in XLA's pool (``PJRT_NPROC``); never fewer than the cores. It must be larger
            than the number of batched factorisations at once, which wait for workers inside workers.

    Raises:
        ValueError: ``workers`` is not an integer from 1 up.
        RuntimeError: JAX has made its CPU client, which reads a setting that would have to change; the message names
            it.
    """
    check_count("workers", workers)
    changes = {}
    if "PJRT_NPROC" not in os.environ and workers > cores():
        changes["PJRT_NPROC"] = str(workers)
    flags = os.environ.get("XLA_FLAGS", "")
    if _SCHEDULER not in flags and jaxlib_version() < _UNTRIED_JAXLIB:  # a flag that XLA does not know ends the process
        changes["XLA_FLAGS"] = f"{flags} --{_SCHEDULER}=false".strip()
    dispatches = _ASYNCHRONOUS.upper() not in os.environ and jax.config.values[_ASYNCHRONOUS]
    late = [*changes, *([_ASYNCHRONOUS] if dispatches else [])]
    if late and _client_exists():
        raise RuntimeError(
            f"JAX has made its CPU client already, which has read {', '.join(late)}: call configure_cpu before the "
            "first computation and before the first robot is loaded, or set the environment before Python starts"
        )
    os.environ.update(changes)
    if dispatches:
        jax.config.update(_ASYNCHRONOUS, False)
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        _limit_lapack()


def _client_exists() -> bool:
    """Return whether JAX has made its CPU client, after which it refuses to change the number of devices."""
    name = "jax_num_cpu_devices"
    now = jax.config.values[name]
    try:
        jax.config.update(name, 2 if now == 1 else 1)
    except RuntimeError:
        return True
    jax.config.update(name, now)
    return False


def _limit_lapack() -> None:
    """Limit SciPy's OpenBLAS to one thread for each call."""
    threadpoolctl = import_module("threadpoolctl")
    linalg = import_module("scipy.linalg")  # loads the library, so that it can be found
    home = os.path.dirname(os.path.realpath(linalg.__path__[0]))
    for library in threadpoolctl.ThreadpoolController().select(internal_api="openblas").lib_controllers:
        if library.filepath.startswith(home):  # in scipy/ or, beside it, scipy.libs/
            library.set_num_threads(1)
