"""Check for the extra of live views."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from ..._errors import missing_extra


def import_viser() -> ModuleType:
    """Return the module viser, or raise ImportError that names the extra.

    Raises:
        ImportError: it is not installed; the message says which extra to install.
    """
    try:
        return import_module("viser")
    except ImportError as missing:
        raise missing_extra("a live view", "viser", "viewer") from missing
