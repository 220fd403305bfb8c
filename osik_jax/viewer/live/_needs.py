"""The extra that a live view needs."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def import_viser() -> ModuleType:
    """viser.

    Raises:
        ImportError: it is not installed; the message says which extra to install.
    """
    try:
        return import_module("viser")
    except ImportError as missing:
        raise ImportError("a live view needs viser: pip install 'osik-jax[viewer]'") from missing
