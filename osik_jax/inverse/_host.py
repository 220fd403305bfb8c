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
    """Return ``function(goals, open)`` computed in chunks of targets, padded with targets that are not open.

    On a CPU, chunks run in threads side by side: XLA runs a program in the thread that calls it. What comes out does
    not depend on how many there are.

    Args:
        function: of a chunk's goals, and which of them are looked for.
        goals: pytree with the targets in front.

    Returns:
        NumPy arrays.
    """
    count = len(jax.tree.leaves(goals)[0])
    size = min(_power_of_two(count), _CHUNK.get(jax.default_backend(), _OTHER_CHUNK))
    starts, goals = range(0, count, size), jax.device_get(goals)

    def run(start: int) -> Any:
        here = min(size, count - start)
        number = np.minimum(np.arange(start, start + size), count - 1)
        out = function(jax.tree.map(lambda a: a[number], goals), np.arange(size) < here)
        return jax.tree.map(lambda a: a[:here], jax.device_get(out))

    return _in_threads(run, starts)


def _in_threads(run: Callable[[int], Any], starts: range) -> Any:
    """Return the results of all chunks one after another; on a CPU they are computed in a thread on each core."""
    if len(starts) == 1 or jax.default_backend() != "cpu":
        parts = [run(start) for start in starts]
    else:
        first = run(0)  # compiles
        with ThreadPoolExecutor(cores()) as threads:
            parts = [first, *threads.map(run, starts[1:])]
    return jax.tree.map(lambda *own: np.concatenate(own), *parts) if len(parts) > 1 else parts[0]


def only(chosen: np.ndarray, function: Callable[..., Any], *args: Any) -> Any:
    """Return ``function(*args)`` for the chosen targets, padded to a power of two; results of others are undefined.

    Args:
        chosen: targets, at least one. (targets,)
        function: of pytrees with the targets in front.
        args: what it is called with for all targets.
    """
    number, args = np.flatnonzero(chosen), jax.device_get(args)
    size = min(_power_of_two(len(number)), _FEW.get(jax.default_backend(), _OTHER_CHUNK))

    def run(start: int) -> Any:
        some = number[start : start + size]
        here = np.pad(some, (0, size - len(some)), mode="edge")
        out = jax.device_get(function(*jax.tree.map(lambda a: a[here], args)))
        return jax.tree.map(lambda a: a[: len(some)], out)

    out = _in_threads(run, range(0, len(number), size))
    place = np.zeros(len(chosen), int)
    place[number] = np.arange(len(number))
    return jax.tree.map(lambda a: a[place], out)


def _power_of_two(count: int) -> int:
    return 1 << (count - 1).bit_length()
