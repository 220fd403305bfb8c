"""Batches larger than memory: chunk by chunk, to disk, killed and continued."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._names import leaf_names
from ._fingerprint import differences, fingerprint
from ._progress import reported
from ._saved import FORMAT, Block, Saved, file_name, finished_chunks, read_manifest, write_chunk, write_manifest

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
    progress: bool = True,
) -> Any:
    """``function(batch, *shared)``, some lanes at a time; on disk, a job that was killed goes on where it was.

    While the devices work on a chunk, the one before is written. Every chunk has the same number of lanes (the last
    one is filled up with copies of its last lane), so one program does for all.

    With ``out``, each chunk is a file of that folder, under its name only when complete, beside a manifest. Call it
    again with the same arguments and it runs only the chunks that are missing. Different ones are refused: compared are
    the number of lanes and of those in a chunk, precision, version, ``label``, and names, shapes and numbers of
    ``batch`` and ``shared``. What the function holds besides is not seen: pass it through ``shared``, or name it in
    ``label``.

    On several hosts (``jax.distributed``), each calls it with the same arguments and a function that ``sharded`` made;
    each writes the lanes that its own devices have.

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
        progress: whether to show a bar.

    Returns:
        With ``out``, a ``Saved``; without, the results as NumPy arrays.

    Raises:
        ValueError: arguments that do not fit, a folder with another job in it (the message names what differs),
            or results that do not have the lanes in front.
    """
    job = _Job(function, batch, shared, _lanes(batch, count), _positive(chunk, "chunk"))
    if out is None:
        return _in_memory(job, progress)
    folder = Path(out)
    _claim(folder, job.manifest(label))
    process, processes = jax.process_index(), jax.process_count()
    todo = _agreed(job.chunks, finished_chunks(folder, process, processes))
    done = job.count - sum(job.size(k) for k in todo)
    structure = None
    with reported(job.count, done, shown=progress and process == 0) as advance:
        for k, result in _one_ahead(job, todo):
            blocks, arrays = _rows(result, job.size(k), job.chunk)
            write_chunk(folder / file_name(k, process, processes), blocks, arrays)
            structure = jax.tree.map(lambda _: 0, result)
            advance(job.size(k))
    if structure is None:
        structure = jax.eval_shape(function, job.inputs(0), *shared)
    return Saved(folder, structure)


class _Job:
    """What is run."""

    def __init__(self, function: Callable[..., Any], batch: Any, shared: tuple[Any, ...], count: int, chunk: int):
        self.function, self.batch, self.shared, self.count, self.chunk = function, batch, tuple(shared), count, chunk
        self.chunks = -(-count // chunk)

    def size(self, k: int) -> int:
        """Lanes of a chunk, less those that fill up the last one."""
        return min(self.chunk, self.count - k * self.chunk)

    def lanes(self, k: int) -> Any:
        """The lanes of a chunk."""
        start, stop = k * self.chunk, k * self.chunk + self.size(k)
        if not callable(self.batch):
            return jax.tree.map(lambda a: a[start:stop], self.batch)
        made = self.batch(start, stop)
        if _lengths(made) != {stop - start}:
            found = ", ".join(str(n) for n in sorted(_lengths(made))) or "none"
            raise ValueError(f"batch({start}, {stop}) made arrays of {found} lanes, expected {stop - start}")
        return made

    def inputs(self, k: int) -> Any:
        """The lanes of a chunk, filled up."""
        missing = self.chunk - self.size(k)
        return jax.tree.map(
            lambda a: np.concatenate([a, np.repeat(a[-1:], missing, 0)]) if missing else a, self.lanes(k)
        )

    def run(self, k: int) -> Any:
        """Results of a chunk, perhaps still being computed."""
        return self.function(self.inputs(k), *self.shared)

    def manifest(self, label: str) -> dict[str, Any]:
        """What has to be the same for the job to go on."""
        first, last = (fingerprint(self.lanes(k)) for k in (0, self.chunks - 1)) if callable(self.batch) else ({}, {})
        inputs = {"first chunk": first, "last chunk": last} if callable(self.batch) else fingerprint(self.batch)
        return {
            "format": FORMAT,
            "osik_jax": version("osik-jax"),
            "label": label,
            "count": self.count,
            "chunk": self.chunk,
            "x64": bool(jax.config.read("jax_enable_x64")),
            "batch": inputs,
            "shared": fingerprint(self.shared),
        }


def _lengths(tree: Any) -> set[int]:
    return {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in jax.tree.leaves(tree)}


def _lanes(batch: Any, count: int | None) -> int:
    if callable(batch):
        if count is None:
            raise ValueError("batch is a function, so count has to say how many lanes there are")
        return _positive(count, "count")
    if count is not None:
        raise ValueError("count goes with a batch that is a function; of arrays it is their length")
    lengths = _lengths(batch)
    if len(lengths) != 1 or 0 in lengths:
        found = ", ".join(str(n) for n in sorted(lengths)) or "nothing is given"
        raise ValueError(f"a batch is arrays with the lanes in front, of one length, at least 1; lengths: {found}")
    return lengths.pop()


def _positive(value: Any, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} is {value!r}; it is a number of lanes, at least 1")
    return int(value)


def _claim(folder: Path, manifest: dict[str, Any]) -> None:
    """Makes the folder, or raises where another job is in it."""
    old = read_manifest(folder)
    if old is None:
        folder.mkdir(parents=True, exist_ok=True)
        write_manifest(folder, manifest)
        return
    changed = differences(old, manifest)
    if changed:
        raise ValueError(f"{folder} has another job in it; name another folder. What differs: {'; '.join(changed)}")


def _agreed(chunks: int, finished: set[int]) -> list[int]:
    """Chunks that one process or another lacks: all run the same ones, for the program is of all of them."""
    lacking = np.array([k not in finished for k in range(chunks)])
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import process_allgather

        lacking = np.asarray(process_allgather(lacking)).reshape(-1, chunks).any(0)
    return np.flatnonzero(lacking).tolist()


def _one_ahead(job: _Job, todo: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """Results in order; the next chunk is under way while one is used."""
    waiting: tuple[int, Any] | None = None
    for k in todo:
        result = job.run(k)
        if waiting is not None:
            yield waiting
        waiting = k, result
    if waiting is not None:
        yield waiting


def _rows(result: Any, size: int, chunk: int) -> tuple[list[Block], dict[str, np.ndarray]]:
    """The lanes of a result that this process has: which ones, and the arrays by name."""
    names, leaves = leaf_names(result), jax.tree.leaves(result)
    wrong = [name for name, leaf in zip(names, leaves, strict=True) if np.shape(leaf)[:1] != (chunk,)]
    if wrong or not leaves:
        found = f"{wrong[0] or 'it'} does not" if wrong else "there are none"
        raise ValueError(f"the function's results have the lanes in front, {chunk} of them: {found}")
    parts = [_blocks(leaf, chunk) for leaf in leaves]
    if any(part.keys() != parts[0].keys() for part in parts):
        raise ValueError("the function's results are split over devices in different ways; make it with sharded")
    starts = sorted(start for start in parts[0] if start < size)
    blocks = [(start, min(start + len(parts[0][start]), size)) for start in starts]
    arrays = [
        np.concatenate([part[a][: b - a] for a, b in blocks] or [np.asarray(part[min(part)])[:0]]) for part in parts
    ]
    return blocks, dict(zip(names, arrays, strict=True))


def _blocks(leaf: Any, chunk: int) -> dict[int, Any]:
    """Rows on this process's devices, by the first lane."""
    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable:
        if jax.process_count() > 1:
            raise ValueError("the function's results are of this process alone; for several, make it with sharded")
        return {0: np.asarray(leaf)}
    shards = {shard.index[0].indices(chunk)[0]: shard.data for shard in leaf.addressable_shards}
    return {start: np.asarray(data) for start, data in shards.items()}


def _in_memory(job: _Job, progress: bool) -> Any:
    if jax.process_count() > 1:
        raise ValueError("several processes have no memory in common: name a folder, out=...")
    parts: list[Any] = []
    with reported(job.count, 0, shown=progress) as advance:
        for k, result in _one_ahead(job, range(job.chunks)):
            _, arrays = _rows(result, job.size(k), job.chunk)
            parts.append(jax.tree.unflatten(jax.tree.structure(result), list(arrays.values())))
            advance(job.size(k))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
