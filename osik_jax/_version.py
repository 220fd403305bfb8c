"""The version of the package, as it was installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def installed_version() -> str:
    """Return the version that ``pip`` knows; ``"0+unknown"`` for sources that are imported without being installed."""
    try:
        return version("osik-jax")
    except PackageNotFoundError:
        return "0+unknown"
