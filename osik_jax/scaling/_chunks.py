"""Batches larger than memory: computed chunk by chunk to disk, resumable."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._errors import OsikValueError
from .._progress import Progress, check_progress, reported
from ..batching._names import leaf_names
from ..numerics._arguments import check_count
from ._fingerprint import differences, fingerprint
from ._folder import only_job
from ._saved import FORMAT, Saved

Batch = Any
"""A pytree of arrays with the lanes in front, or a function from first and last lane (exclusive) to such a pytree."""


def run_in_chunks(
    function: Callable[..., Any],
    batch: Batch,
    *,
    chunk: int,
    shared: tuple[Any, ...] = (),
    count: int | None = None,
    out: str | os.PathLike[str] | None = None,
    label: str = "",
    progress: Progress = True,
    unit: str = "lanes",
) -> Any:
    """Return ``function(batch, *shared)`` computed chunk by chunk; with a folder, an interrupted job continues.

    While the devices work on a chunk, the one before is written. Every chunk has the same number of lanes (the last
    one is filled up with copies of its last lane), so one program does for all.

    With ``out``, each chunk is a file of that folder, under its name only when complete, beside a manifest. Call it
    again with the same arguments and it runs only the chunks that are missing or damaged: each file that is there is
    read once, against its checksums, and has to be of this job. Different arguments are refused: compared are the
    number of lanes and of those in a chunk, precision, version, ``label``, and names, shapes and numbers of ``batch``
    and ``shared``. What the function holds besides is not seen: pass it through ``shared``, or name it in ``label``.
    One job works in a folder at a time.

    On several hosts, each runs its own part of the batch into a folder of its own, without ``jax.distributed``.

    Args:
        function: of a pytree with the lanes in front, and of ``shared``; returns such a pytree. Best made by
            ``sharded``, or by ``jax.jit(jax.vmap(...))``.
        batch: a pytree of arrays, NumPy's to keep them off the devices; or a function ``batch(start, stop)`` that makes
            the lanes from start to stop, the same each time. Of a function, the first and last chunk are compared.
        chunk: lanes that run at a time: as many as fit the devices' memory, at best a multiple of their number.
        shared: what all lanes have in common.
        count: number of lanes, where ``batch`` is a function.
        out: folder for the results. Default: none; they are gathered in memory.
        label: a word for what the function does, kept in the manifest.
        progress: whether to show a bar; or a function of the number of lanes that are done and of all, called after
            each chunk, when it is written.
        unit: what the bar calls the lanes, in the plural.

    Returns:
        With ``out``, a ``Saved``, whose arrays come by name; without, the results as NumPy arrays.

    Warns:
        UserWarning: a damaged file was found; the message names it, and its chunk is run again.

    Raises:
        ValueError: arguments that do not fit, a folder with another job in it (the message names what differs),
            several processes of ``jax.distributed``, or results that do not have the lanes in front, are of other
            names, types or shapes than in other chunks, or of a type that a ``.npz`` does not keep.
        BlockingIOError: another process works in the folder.
        OSError: the folder cannot be made or written to; what is finished stays.
    """
    check_progress(progress)
    check_count("chunk", chunk)
    if jax.process_count() > 1:
        raise OsikValueError(
            "run_in_chunks works in one process: start one on each host without jax.distributed, with its own part of "
            "the batch and its own folder"
        )
    job = _Job(function, batch, shared, _lanes(batch, count), int(chunk))
    if out is None:
        parts = [result for _, result in job.results(range(job.chunks), progress, unit)]
        return jax.tree.map(lambda *rows: np.concatenate(rows), *parts)
    saved = Saved(Path(out), job.manifest(label))
    with only_job(saved.folder):
        todo = saved.claim()
        if 0 < len(todo) < job.chunks:
            done = min(set(range(job.chunks)).difference(todo)) * job.chunk
            job.layout = _layout(saved[done : done + 1])
        for k, result in job.results(todo, progress, unit):
            saved.write(k, dict(zip(leaf_names(result), jax.tree.leaves(result), strict=True)))
    return saved


class _Job:
    """Function, batch and chunk size of a job; and the results' types and shapes, once they are known."""

    layout: dict[str, str] | None = None

    def __init__(self, function: Callable[..., Any], batch: Any, shared: tuple[Any, ...], count: int, chunk: int):
        self.function, self.batch, self.shared, self.count, self.chunk = function, batch, tuple(shared), count, chunk
        self.chunks = -(-count // chunk)

    def size(self, k: int) -> int:
        """Return the number of lanes of a chunk, without padding."""
        return min(self.chunk, self.count - k * self.chunk)

    def lanes(self, k: int) -> Any:
        """Return the lanes of a chunk."""
        start, stop = k * self.chunk, k * self.chunk + self.size(k)
        if not callable(self.batch):
            return jax.tree.map(lambda a: a[start:stop], self.batch)
        made = self.batch(start, stop)
        if _lengths(made) != {stop - start}:
            found = ", ".join(str(n) for n in sorted(_lengths(made))) or "none"
            raise OsikValueError(f"batch({start}, {stop}) made arrays of {found} lanes, expected {stop - start}")
        return made

    def inputs(self, k: int) -> Any:
        """Return the inputs of a chunk, padded."""
        places = np.minimum(np.arange(self.chunk), self.size(k) - 1)
        return jax.tree.map(lambda a: a[places] if self.size(k) < self.chunk else a, self.lanes(k))

    def run(self, k: int) -> Any:
        """Return the results of a chunk, perhaps still being computed."""
        return self.function(self.inputs(k), *self.shared)

    def manifest(self, label: str) -> dict[str, Any]:
        """Return the inputs that must be the same for a job to resume."""
        first, last = (fingerprint(self.lanes(k)) for k in (0, self.chunks - 1)) if callable(self.batch) else ({}, {})
        return {
            "format": FORMAT,
            "osik_jax": version("osik-jax"),
            "label": str(label),
            "count": self.count,
            "chunk": self.chunk,
            "x64": bool(jax.config.read("jax_enable_x64")),
            "batch": {"first chunk": first, "last chunk": last} if callable(self.batch) else fingerprint(self.batch),
            "shared": fingerprint(self.shared),
        }

    def results(self, todo: Sequence[int], progress: Progress, unit: str) -> Iterator[tuple[int, Any]]:
        """Yield chunks with their results in order, as NumPy arrays; the devices work on the next chunk meanwhile."""
        missing = sum(map(self.size, todo))
        with reported(self.count, self.count - missing, progress, unit) as advance:
            started = [self.run(k) for k in todo[:1]]
            for place, k in enumerate(todo, 1):
                try:
                    started += [self.run(following) for following in todo[place : place + 1]]
                finally:  # what is computed is kept, also when the next chunk fails
                    yield k, self._without_padding(started.pop(0), k)
                    advance(self.size(k))

    def _without_padding(self, result: Any, k: int) -> Any:
        """Return the lanes of a chunk as NumPy arrays."""
        names, leaves = leaf_names(result), jax.tree.leaves(result)
        wrong = [name or "it" for name, leaf in zip(names, leaves, strict=True) if np.shape(leaf)[:1] != (self.chunk,)]
        if wrong or not leaves:
            found = f"{wrong[0]} does not" if wrong else "there are none"
            raise OsikValueError(f"the function's results have the lanes in front, {self.chunk} of them: {found}")
        if len(set(names)) < len(names):
            raise OsikValueError(f"two arrays of the function's results are called {max(names, key=names.count)!r}")
        found = _layout(dict(zip(names, leaves, strict=True)))
        changed = differences(self.layout or found, found)
        if changed:
            raise OsikValueError(f"the function's results of chunk {k} are not like those before: {'; '.join(changed)}")
        self.layout = found
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: self.size(k)], result)


def _layout(arrays: Mapping[str, Any]) -> dict[str, str]:
    """Return type and shape of one lane of each array."""
    return {name or "it": f"{array.dtype} {array.shape[1:]}" for name, array in arrays.items()}


def _lengths(tree: Any) -> set[int]:
    return {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in jax.tree.leaves(tree)}


def _lanes(batch: Any, count: int | None) -> int:
    if callable(batch):
        if count is None:
            raise OsikValueError("batch is a function, so count has to say how many lanes there are")
        check_count("count", count)
        return int(count)
    if count is not None:
        raise OsikValueError("count goes with a batch that is a function; of arrays it is their length")
    lengths = _lengths(batch)
    if len(lengths) != 1 or 0 in lengths:
        found = ", ".join(str(n) for n in sorted(lengths)) or "nothing is given"
        raise OsikValueError(f"a batch is arrays with the lanes in front, of one length, at least 1; lengths: {found}")
    return lengths.pop()
