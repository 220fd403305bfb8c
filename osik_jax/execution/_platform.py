"""Questions about the device that a program is made for, and about sizes that are not known yet."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def cuda_is_default() -> bool:
    """Return whether the device that JAX computes on where it is not told otherwise is a GPU.

    Beside one, under ``jax.default_device`` of a CPU, there is nothing to compile a kernel for.
    """
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    return getattr(device, "platform", device) in ("gpu", "cuda")


def cpu_is_default() -> bool:
    """Return whether JAX computes on a CPU where it is not told otherwise.

    There, a program may be laid out for what costs time on a core: each operation by itself, and what its cache holds.
    """
    return jax.default_backend() == "cpu"


def is_symbolic(count: Any) -> bool:
    """Return whether a size is a symbol of ``jax.export``, which compares with no number."""
    return not isinstance(count, int | np.integer)
