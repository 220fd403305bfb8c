"""Execution of a batch of targets: in chunks of one shape, several at a time on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from ..execution._workers import cores

_CHUNK = {"cpu": 1024}
_OTHER_CHUNK = 65536
_FEW = {"cpu": 32}
"""Targets that run together: of all, and of some whose answers do not depend on the others. Shapes are powers of two up
to here, so that few programs are compiled.
"""
_MOST_LANES = {"cpu": 128}
_OTHER_LANES = 131072
"""Searches that go on together: as many as a core's cache holds, or as keep a GPU busy."""
_FEWEST_LANES, _EACH = 16, 8
"""The least; and searches for a target that a GPU goes on with together, where there are few."""


def lanes_for(targets: int) -> int:
    """Return the number of simultaneous searches for this number of targets."""
    backend = jax.default_backend()
    wanted = targets if backend == "cpu" else _EACH * targets
    return min(max(_power_of_two(wanted), _FEWEST_LANES), _MOST_LANES.get(backend, _OTHER_LANES))


def in_chunks(function: Callable[[Any, np.ndarray], Any], goals: Any) -> Any:
    """Return ``function(goals, open)`` of chunks of targets, one after another, as NumPy arrays.

    ``open``: which targets of a chunk are looked for; the others fill it up. The results do not depend on the number of
    threads.
    """
    count = len(jax.tree.leaves(goals)[0])
    size = min(_power_of_two(count), _CHUNK.get(jax.default_backend(), _OTHER_CHUNK))
    return _in_parts(function, goals, np.arange(count), size)


def only(chosen: np.ndarray, function: Callable[..., Any], *args: Any) -> Any:
    """Return ``function(*args)`` for the chosen targets, padded to a power of two; results of others are undefined.

    At least one of the targets is chosen. The arguments are pytrees with all targets in front.
    """
    number = np.flatnonzero(chosen)
    size = min(_power_of_two(len(number)), _FEW.get(jax.default_backend(), _OTHER_CHUNK))
    out = _in_parts(lambda args, _: function(*args), args, number, size)
    place = np.zeros(len(chosen), int)
    place[number] = np.arange(len(number))
    return jax.tree.map(lambda a: a[place], out)


def _in_parts(function: Callable[[Any, np.ndarray], Any], given: Any, number: np.ndarray, size: int) -> Any:
    """Return the results for some targets, ``size`` at a time; the last ones are padded with the last target.

    On a CPU, parts run in a thread on each core: XLA runs a program in the thread that calls it.
    """
    given, starts = jax.device_get(given), range(0, len(number), size)

    def run(start: int) -> Any:
        some = number[start : start + size]
        here = np.pad(some, (0, size - len(some)), mode="edge")
        out = function(jax.tree.map(lambda a: a[here], given), np.arange(size) < len(some))
        return jax.tree.map(lambda a: a[: len(some)], jax.device_get(out))

    if len(starts) == 1 or jax.default_backend() != "cpu":
        parts = [run(start) for start in starts]
    else:
        first = run(0)  # compiles
        with ThreadPoolExecutor(cores()) as threads:
            parts = [first, *threads.map(run, starts[1:])]
    return jax.tree.map(lambda *own: np.concatenate(own), *parts) if len(parts) > 1 else parts[0]


def _power_of_two(count: int) -> int:
    return 1 << (count - 1).bit_length()
