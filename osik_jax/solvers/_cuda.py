"""Whether kernels of our own may take part in a program."""

from __future__ import annotations

import os
from importlib.util import find_spec

import jax

SWITCH = "OSIK_FUSED"
"""Environment variable; 0 keeps to XLA. It is read when a program is traced."""


def wanted() -> bool:
    """Whether they are not switched off, Warp is installed and there is a GPU."""
    return os.environ.get(SWITCH, "1") != "0" and find_spec("warp") is not None and available()


def available() -> bool:
    """Whether the device that JAX computes on where it is not told otherwise is a GPU.

    Beside one, under ``jax.default_device`` of a CPU, there is nothing to compile a kernel for.
    """
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    return getattr(device, "platform", device) in ("gpu", "cuda")
