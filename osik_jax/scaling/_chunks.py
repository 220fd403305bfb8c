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
from ._chunk_file import Block, Part, read_chunk, remove_partial_files, write_chunk
from ._fingerprint import differences, fingerprint, identifier
from ._folder import check_space, claim, only_job
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
    read once, against its checksums, and has to be of this chunk and this job. Different arguments are refused:
    compared are the number of lanes and of those in a chunk, precision, version, ``label``, and names, shapes and
    numbers of ``batch`` and ``shared``. What the function holds besides is not seen: pass it through ``shared``, or
    name it in ``label``. One job works in a folder at a time.

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
        progress: whether to show a bar; or a function of the number of lanes that are done and of all, called after
            each chunk, when it is written (on several hosts by the first process).
        unit: what the bar calls the lanes, in the plural.

    Returns:
        With ``out``, a ``Saved``; without, the results as NumPy arrays.

    Warns:
        UserWarning: a damaged file was found; the message names it, and its chunk is run again.

    Raises:
        ValueError: arguments that do not fit, a folder with another job in it (the message names what differs),
            or results that do not have the lanes in front, are of another type or shape than in other chunks, or of a
            type that a ``.npz`` does not keep.
        BlockingIOError: another process works in the folder; the message has its number and host.
        OSError: the folder cannot be made or written to, or its disk is too small for the results that are missing.
            Before the first chunk is run, where it can be known; later, what is finished stays.
    """
    check_progress(progress)
    check_count("chunk", chunk)
    job = _Job(function, batch, shared, _lanes(batch, count), int(chunk))
    if out is None:
        return _in_memory(job, progress, unit)
    folder = Path(out)
    with only_job(folder, jax.process_index()) as alone:
        if alone:
            remove_partial_files(folder)
        return Saved(folder, _to_disk(job, folder, label, progress, unit))


def _to_disk(job: _Job, folder: Path, label: str, progress: Progress, unit: str) -> Any:
    """Run the chunks that are missing; return a pytree of the structure of the results."""
    process, processes, manifest = jax.process_index(), jax.process_count(), job.manifest(label)
    finished = claim(folder, manifest, process, processes)
    todo = _agreed(job.chunks, set(finished))
    like, missing = job.expected(), sum(job.size(k) for k in todo)
    check_space(folder, _bytes(like) * missing // job.chunk // processes)
    layout = _Layout()
    if finished and todo:
        part = next(iter(finished.values()))[0]
        layout.check(read_chunk(folder / part.file_name, part, manifest["job"])[1], part.chunk)
    with reported(job.count, job.count - missing, progress if process == 0 else False, unit) as advance:
        for k, result in _one_ahead(job, todo):
            blocks, arrays = _rows(result, job.size(k), job.chunk)
            layout.check(arrays, k)
            write_chunk(folder, Part(k, process, processes), manifest["job"], blocks, arrays)
            like = jax.tree.map(lambda _: 0, result)
            advance(job.size(k))
    return like if like is not None else job.run(0)


class _Job:
    """Function, batch and chunk size of a job."""

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
        missing = self.chunk - self.size(k)
        return jax.tree.map(
            lambda a: np.concatenate([a, np.repeat(a[-1:], missing, 0)]) if missing else a, self.lanes(k)
        )

    def run(self, k: int) -> Any:
        """Return the results of a chunk, perhaps still being computed."""
        return self.function(self.inputs(k), *self.shared)

    def expected(self) -> Any:
        """Return shapes and types of a chunk's results without computing them; None if they cannot be traced."""
        try:
            return jax.eval_shape(self.function, self.inputs(0), *self.shared)
        except Exception:  # a function of NumPy, or one that is wrong: then running it says how
            return None

    def manifest(self, label: str) -> dict[str, Any]:
        """Return the inputs that must be the same for a job to resume, with an identifier that each chunk carries."""
        first, last = (fingerprint(self.lanes(k)) for k in (0, self.chunks - 1)) if callable(self.batch) else ({}, {})
        inputs = {"first chunk": first, "last chunk": last} if callable(self.batch) else fingerprint(self.batch)
        said = {
            "format": FORMAT,
            "osik_jax": version("osik-jax"),
            "label": label,
            "count": self.count,
            "chunk": self.chunk,
            "x64": bool(jax.config.read("jax_enable_x64")),
            "batch": inputs,
            "shared": fingerprint(self.shared),
        }
        return said | {"job": identifier(said)}


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


def _agreed(chunks: int, finished: set[int]) -> list[int]:
    """Return the chunks that any process lacks; all processes run them, because they share one program."""
    lacking = np.array([k not in finished for k in range(chunks)])
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import process_allgather

        lacking = np.asarray(process_allgather(lacking)).reshape(-1, chunks).any(0)
    return np.flatnonzero(lacking).tolist()


def _one_ahead(job: _Job, todo: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """Yield results in order while the next chunk is under way; its failure comes after the result before it."""
    waiting: tuple[int, Any] | None = None
    for k in todo:
        try:
            result = job.run(k)
        except BaseException:  # Ctrl-C too
            if waiting is not None:
                yield waiting
            raise
        if waiting is not None:
            yield waiting
        waiting = k, result
    if waiting is not None:
        yield waiting


def _rows(result: Any, size: int, chunk: int) -> tuple[list[Block], dict[str, np.ndarray]]:
    """Return the lanes of a result that this process has: their indices, and the arrays by name."""
    names, leaves = leaf_names(result), jax.tree.leaves(result)
    wrong = [name for name, leaf in zip(names, leaves, strict=True) if np.shape(leaf)[:1] != (chunk,)]
    if wrong or not leaves:
        found = f"{wrong[0] or 'it'} does not" if wrong else "there are none"
        raise OsikValueError(f"the function's results have the lanes in front, {chunk} of them: {found}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise OsikValueError(f"two arrays of the function's results are called {twice!r}")
    parts = [_blocks(leaf, chunk) for leaf in leaves]
    if any(part.keys() != parts[0].keys() for part in parts):
        raise OsikValueError("the function's results are split over devices in different ways; make it with sharded")
    starts = sorted(start for start in parts[0] if start < size)
    blocks = [(start, min(start + len(parts[0][start]), size)) for start in starts]
    arrays = [
        np.concatenate([part[a][: b - a] for a, b in blocks] or [np.asarray(part[min(part)])[:0]]) for part in parts
    ]
    return blocks, dict(zip(names, arrays, strict=True))


def _blocks(leaf: Any, chunk: int) -> dict[int, Any]:
    """Return rows on this process's devices, by the first lane."""
    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable:
        if jax.process_count() > 1:
            raise OsikValueError("the function's results are of this process alone; for several, make it with sharded")
        return {0: np.asarray(leaf)}
    shards = {shard.index[0].indices(chunk)[0]: shard.data for shard in leaf.addressable_shards}
    return {start: np.asarray(data) for start, data in shards.items()}


class _Layout:
    """Names, types and shapes of the arrays, which have to be the same in every chunk."""

    def __init__(self) -> None:
        self.known: tuple[int, dict[str, str]] | None = None

    def check(self, arrays: Mapping[str, np.ndarray], chunk: int) -> None:
        """Raise ValueError if a chunk differs from the first one."""
        found = {name or "it": f"{array.dtype} {array.shape[1:]}" for name, array in arrays.items()}
        if self.known is None:
            self.known = chunk, found
        first, known = self.known
        if known != found:
            changed = "; ".join(differences(known, found))
            raise OsikValueError(
                f"the function's results of chunk {chunk} are not like those of chunk {first}: {changed}"
            )


def _bytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _in_memory(job: _Job, progress: Progress, unit: str) -> Any:
    if jax.process_count() > 1:
        raise OsikValueError("several processes have no memory in common: name a folder, out=...")
    parts: list[dict[str, np.ndarray]] = []
    layout, result = _Layout(), None
    with reported(job.count, 0, progress, unit) as advance:
        for k, result in _one_ahead(job, range(job.chunks)):
            _, arrays = _rows(result, job.size(k), job.chunk)
            layout.check(arrays, k)
            parts.append(arrays)
            advance(job.size(k))
    whole = [np.concatenate([part[name] for part in parts]) for name in parts[0]]
    return jax.tree.unflatten(jax.tree.structure(result), whole)
