"""Platform of a program, and symbolic sizes."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import jax
import numpy as np


def default_platform() -> str:
    """Return the platform of JAX's default device, which ``jax.default_device`` may have chosen."""
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    return getattr(device, "platform", device)


def cuda_is_default() -> bool:
    """Return whether JAX's default device is a GPU.

    Under ``jax.default_device`` of a CPU it is not, and no kernel is compiled for a GPU.
    """
    return default_platform() in ("gpu", "cuda")


def cpu_is_default() -> bool:
    """Return whether JAX's default backend is a CPU.

    Programs for a CPU minimise the number of operations and work in blocks that fit into the cache.
    """
    return jax.default_backend() == "cpu"


def on_host() -> AbstractContextManager[Any]:
    """Return a context in which JAX computes on the CPU, if a GPU is the default and JAX has the CPU too.

    For a few numbers that Python needs: each transfer between host and GPU takes as long as a search for a pose.
    """
    if not cuda_is_default():
        return nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX_PLATFORMS names the GPU alone
        return nullcontext()


def is_symbolic(count: Any) -> bool:
    """Return whether a size is a symbol of ``jax.export``, which cannot be compared with numbers."""
    return not isinstance(count, int | np.integer)
