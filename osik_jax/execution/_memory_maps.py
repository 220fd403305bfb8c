"""Memory maps of a process, of which each compiled program keeps hundreds on Linux."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from .._errors import warn

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_SHARE = 0.75
"""Fraction of the system's maximum at which a warning is given, about 25 programs before the process would end."""
_seen: dict[str, int] = {}
"""Number of programs at the last call, by name of the function."""
_warned: list[int] = []
"""The number of maps of which the process has been warned; empty before."""


def watch_memory_maps(name: str, compiled: Any) -> None:
    """Warn once if the process approaches Linux's maximum of memory maps, at which it would be ended.

    Maps are counted only if the jitted function has more programs than at the last call.
    """
    programs = compiled._cache_size()
    if programs == _seen.get(name, 0):
        return
    _seen[name] = programs  # fewer than before where jax.clear_caches() was called
    maps, most = counted_maps(), _most_maps()
    if maps is not None and most is not None and maps > _SHARE * most and not _warned:
        _warned.append(maps)
        warn(
            f"this process has {maps} of the {most} memory maps that the system allows. Each compiled structure of "
            "tasks takes several hundred, and at the limit the process is aborted. Change numbers by replace, which "
            "compiles nothing; call jax.clear_caches(); or raise the limit: sysctl -w vm.max_map_count=262144"
        )


def counted_maps() -> int | None:
    """Return the number of memory maps of this process; None if the system does not tell."""
    try:
        return _MAPS.read_bytes().count(b"\n")
    except OSError:
        return None


@cache
def _most_maps() -> int | None:
    try:
        return int(_MOST.read_text())
    except (OSError, ValueError):
        return None
