"""What JAX's device says of itself."""

from __future__ import annotations

import jax


def device_bytes() -> int | None:
    """Most that the default device has held in this process, where it says so."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def device_name() -> str | None:
    """Of the default device; None for a CPU."""
    device = jax.devices()[0]
    return None if device.platform == "cpu" else device.device_kind
