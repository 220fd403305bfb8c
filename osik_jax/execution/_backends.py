"""Choice of backend: the table of kernels, and the dispatch by platform.

A solver takes a kernel's candidate, certifies it in plain JAX, and searches if that fails. The search is the definition
and needs no kernel. ``backend``, a static option of solvers and schemes, chooses. Kernels of the classical null-space
projection, of kinematics and of task rows replace plain JAX without a search (``_computed.py``). With bounds a
null-space kernel searches, and plain JAX searches again for problems that it cannot solve. A scheme's backend is that
of its whole step.

    backend   weighted QP                          hierarchy                           null space
    "core"    CPUs: any precision, least squares   CPUs: any precision, any shape      CPUs: any precision,
                                                                                       any shape
              CUDA: any precision, least squares   CUDA: any precision                 CUDA: classical or with
                                                                                       bounds, any precision
    "jax"     none: plain JAX alone, on any platform

    of a step with one of these schemes       kinematics, Jacobians of frames, centre of mass, rows of pose tasks
    "core"    CPUs and CUDA: any robot, any precision

    of inverse kinematics                     searches for poses of frames that hinges and slides carry, in scenes too
    "core"    CPUs and CUDA: any robot, any precision; "nearest" and "all" in a scene: the
              CPU beside a GPU

    of retargeting                            iterations of a plan                a plan's banded systems
    "core"                                    CPUs: any robot, any precision      CPUs: inside the former
                                                                                  CUDA: float32, about 40 dofs at most

"core" is the C++ of ``osik_jax/core``, compiled for CPUs when the package is installed and for a GPU at the first call.
On a GPU a problem has to fit into shared memory; plain JAX solves larger ones. "auto" takes the core if it is installed
and fits, else the search. The platform of a program is decided when it is lowered, not when it is traced
(``on_platforms``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import jax

from .._errors import OsikValueError
from ..core import _cuda, _library
from ._platform import cuda_is_default, default_platform, is_symbolic
from ._rules import KERNEL_IN_EXPORT, by_platform, not_exported

Backend = Literal["auto", "jax", "core"]
BACKENDS: tuple[str, ...] = get_args(Backend)

_PLATFORM = {"core": "cpu", "core-cuda": "cuda"}
CPU_KERNELS = {name for name, platform in _PLATFORM.items() if platform == "cpu"}


def core_is_here() -> bool:
    """Return whether the compiled core runs on JAX's default device."""
    return _cuda.installed() if cuda_is_default() else default_platform() == "cpu" and _library.installed()


def check_backend(backend: Any) -> Backend:
    """Return a checked backend."""
    if backend not in BACKENDS:
        raise OsikValueError(f"backend is {backend!r}; backends: {', '.join(BACKENDS)}")
    if backend == "core" and not _library.installed():
        raise ModuleNotFoundError(f"backend='core': {_library.core().reason}", name="osik_jax.core")
    return backend


def takes(backend: Backend, kernel: str, *, fits: bool) -> bool:
    """Return whether a solver includes the candidates of a kernel in its program.

    ``fits`` says whether the solver has such a kernel for problems of this kind, precision and shape.
    """
    if kernel == "core-cuda":
        return backend in ("auto", "core") and fits and cuda_is_default()
    if backend == kernel:
        check_backend(backend)
        if not fits:
            raise OsikValueError(
                f"backend={kernel!r} has no kernel for problems of this kind, precision or shape; take 'auto'"
            )
        return True
    return backend == "auto" and fits and _library.installed()


def on_platforms(kernels: dict[str, Callable[..., Any]], search: Callable[..., Any], *args: Any) -> Any:
    """Call a kernel's function on the kernel's platform, and the search on other platforms.

    The functions are not differentiated, and take all traced arrays as arguments. One program may be lowered for
    several platforms.
    """
    if not kernels:
        return search(*args)
    if any(is_symbolic(size) for leaf in jax.tree.leaves(args) for size in jax.numpy.shape(leaf)):
        raise OsikValueError(KERNEL_IN_EXPORT)

    def kept_here(kernel: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given: kernel(*not_exported(given))

    return by_platform({_PLATFORM[name]: kept_here(kernel) for name, kernel in kernels.items()}, search, *args)
