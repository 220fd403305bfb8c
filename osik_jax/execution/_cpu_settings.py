"""Settings of the CPU runtime for the whole process; an import makes none."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import version

import jax

from .._errors import OsikValueError
from ._workers import ENOUGH, cores, jaxlib_version

_UNTRIED_JAXLIB = (0, 13)  # the same bound as that of jax in pyproject.toml
_SCHEDULER = "xla_cpu_enable_concurrency_optimized_scheduler"
_FUSION = "xla_cpu_use_fusion_emitters"
_NO_FUSION_FLAG = (0, 11)
"""A jaxlib from this one on does not know ``_FUSION``, and a flag that XLA does not know ends the process."""
_ASYNCHRONOUS = "jax_cpu_enable_async_dispatch"


def configure_cpu(
    *,
    workers: int = ENOUGH,
    lapack_threads: int = 1,
    side_by_side: bool = False,
    asynchronous: bool = False,
    older_fusions: bool = False,
) -> None:
    """Configure XLA's CPU runtime for small problems, for the whole process, before the first JAX computation.

    Call it once, in a program and not in a library. Your own settings stay: ``PJRT_NPROC``, these flags in
    ``XLA_FLAGS``, ``OPENBLAS_NUM_THREADS``, ``JAX_CPU_ENABLE_ASYNC_DISPATCH``. Calling it again with the same arguments
    does nothing. Answers do not depend on it. Without it one robot's control step takes longer, and on few cores two
    batches of factorisations in one program can wait for each other for ever.

    Args:
        workers: least number of threads in XLA's pool (``PJRT_NPROC``); never fewer than the cores. It must be larger
            than the number of batched factorisations at once, which wait for workers inside workers.
        lapack_threads: threads of one LAPACK call, of SciPy's OpenBLAS, which jaxlib uses. NumPy has its own.
        side_by_side: whether XLA orders operations so that they can run at the same time, which costs more than it
            gains if they take microseconds. Not set with untested releases of jaxlib, because a flag that XLA does not
            know ends the process.
        asynchronous: whether a program of one CPU device runs in another thread than its caller
            (``jax_cpu_enable_async_dispatch``).
        older_fusions: whether XLA fuses operations as before its fusion emitters (jaxlib before 0.11). Programs compile
            sooner and run as fast. Do not combine it with XLA's optimiser switched off: nested loops may never end.

    Raises:
        ValueError: ``workers`` or ``lapack_threads`` is not an integer from 1 up, or ``older_fusions`` with a jaxlib
            from 0.11 on.
        RuntimeError: JAX has made its CPU client, which reads a setting that would have to change; the message names
            it.
    """
    for name, value in (("workers", workers), ("lapack_threads", lapack_threads)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise OsikValueError(f"{name} is {value!r}; it is an integer, at least 1")
    if older_fusions and jaxlib_version() >= _NO_FUSION_FLAG:
        raise OsikValueError(f"older_fusions needs a jaxlib before 0.11; this is {version('jaxlib')}")
    changes = _environment(workers, side_by_side, older_fusions)
    dispatch = _dispatch(asynchronous)
    late = [*changes, *([_ASYNCHRONOUS] if dispatch else [])]
    if late and _client_exists():
        raise RuntimeError(
            f"JAX has made its CPU client already, which has read {', '.join(late)}: call configure_cpu before the "
            "first computation and before the first robot is loaded, or set the environment before Python starts"
        )
    os.environ.update(changes)
    if dispatch:
        jax.config.update(_ASYNCHRONOUS, asynchronous)
    _limit_lapack(lapack_threads)


def _environment(workers: int, side_by_side: bool, older_fusions: bool) -> dict[str, str]:
    """Return the environment variables to set."""
    changes = {}
    if "PJRT_NPROC" not in os.environ and workers > cores():
        changes["PJRT_NPROC"] = str(workers)
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = {_SCHEDULER: side_by_side} if jaxlib_version() < _UNTRIED_JAXLIB else {}
    wanted |= {_FUSION: False} if older_fusions else {}
    added = [f"--{name}={str(value).lower()}" for name, value in wanted.items() if name not in flags]
    if added:
        changes["XLA_FLAGS"] = " ".join([flags, *added]).strip()
    return changes


def _dispatch(asynchronous: bool) -> bool:
    """Return whether the option for asynchronous dispatch has to change."""
    return _ASYNCHRONOUS.upper() not in os.environ and jax.config.values[_ASYNCHRONOUS] != asynchronous


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


def _limit_lapack(threads: int) -> None:
    """Limit SciPy's OpenBLAS to this number of threads for each call."""
    if "OPENBLAS_NUM_THREADS" in os.environ:
        return
    threadpoolctl = import_module("threadpoolctl")
    linalg = import_module("scipy.linalg")  # loads the library, so that it can be found
    home = os.path.dirname(os.path.realpath(linalg.__path__[0]))
    for library in threadpoolctl.ThreadpoolController().select(internal_api="openblas").lib_controllers:
        if library.filepath.startswith(home):  # in scipy/ or, beside it, scipy.libs/
            library.set_num_threads(threads)
