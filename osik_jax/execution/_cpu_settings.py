"""Settings of the CPU runtime: explicit, for the process as a whole, and never made by an import."""

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
    """Set XLA's CPU runtime up for small problems, in the process as a whole, before the first JAX computation.

    Call it once, in a program and not in a library. What you have set already stays: ``PJRT_NPROC``, these flags
    in ``XLA_FLAGS``, ``OPENBLAS_NUM_THREADS``, ``JAX_CPU_ENABLE_ASYNC_DISPATCH``. Calling it again with the same
    arguments does nothing. Without it every answer is the same; one robot's control step takes longer, and two
    batches of factorisations at once in one program can wait for each other for ever where there are few cores.

    Args:
        workers: threads in XLA's pool, at least (``PJRT_NPROC``); never fewer than there are cores. More than batched
            factorisations run at once: jaxlib's wait for workers inside workers.
        lapack_threads: threads of one LAPACK call: those of SciPy's OpenBLAS, which jaxlib uses. NumPy's is another.
        side_by_side: whether XLA orders operations so that they can run at the same time. That costs more than it gains
            where they take microseconds. Left alone with a jaxlib that it was not tried with, for a flag that XLA does
            not know ends the process.
        asynchronous: whether a program of one CPU device is handed to another thread instead of being run in the one
            that calls it (``jax_cpu_enable_async_dispatch``).
        older_fusions: whether XLA fuses operations as it did before its fusion emitters: programs compile
            sooner and run as fast, with a jaxlib before 0.11, which has both ways. Try your program with it: together
            with XLA's optimiser switched off, loops in loops were seen to go on for ever.

    Raises:
        ValueError: ``workers`` or ``lapack_threads`` is no integer from 1 up; ``older_fusions`` with a jaxlib that has
            none.
        RuntimeError: JAX has its CPU client already, and a setting that would have to be another is read when that is
            made; the message names it.
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
    """Return what the environment lacks."""
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
    """Return whether the way in which programs are run has to be changed."""
    return _ASYNCHRONOUS.upper() not in os.environ and jax.config.values[_ASYNCHRONOUS] != asynchronous


def _client_exists() -> bool:
    """Return whether JAX has made its devices: after that it refuses to be told their number."""
    name = "jax_num_cpu_devices"
    now = jax.config.values[name]
    try:
        jax.config.update(name, 2 if now == 1 else 1)
    except RuntimeError:
        return True
    jax.config.update(name, now)
    return False


def _limit_lapack(threads: int) -> None:
    """Limit SciPy's OpenBLAS to so many threads a call."""
    if "OPENBLAS_NUM_THREADS" in os.environ:
        return
    threadpoolctl = import_module("threadpoolctl")
    linalg = import_module("scipy.linalg")  # loads the library, so that it can be found
    home = os.path.dirname(os.path.realpath(linalg.__path__[0]))
    for library in threadpoolctl.ThreadpoolController().select(internal_api="openblas").lib_controllers:
        if library.filepath.startswith(home):  # in scipy/ or, beside it, scipy.libs/
            library.set_num_threads(threads)
