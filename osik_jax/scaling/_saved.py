"""Results in a folder: a file for each chunk, and a manifest that says what of."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._names import leaf_names

FORMAT = 1
MANIFEST = "manifest.json"
_LANES = "lanes"
_RESULT = "result."
_FILE = re.compile(r"(\d{8})(?:\.(\d+)-of-(\d+))?\.npz")

Block = tuple[int, int]
"""First lane, and the one after the last."""


def file_name(chunk: int, process: int, processes: int) -> str:
    """Of the results that one process has of a chunk."""
    return f"{chunk:08d}.npz" if processes == 1 else f"{chunk:08d}.{process}-of-{processes}.npz"


def write_chunk(path: Path, blocks: Sequence[Block], arrays: Mapping[str, np.ndarray]) -> None:
    """Results of some lanes; the file has its name only when it is complete and on the disk."""
    named = {_RESULT + name: array for name, array in arrays.items()}
    with _whole(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **{_LANES: np.array(blocks, np.int64).reshape(-1, 2)}, **named)
        file.flush()
        os.fsync(file.fileno())


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """What the chunks are of."""
    with _whole(folder / MANIFEST) as partial:
        partial.write_text(json.dumps(manifest, indent=1) + "\n")


class _whole:
    """A file under another name, which gets its own when all went well."""

    def __init__(self, path: Path):
        self.path, self.partial = path, path.with_name(f".{path.name}.{jax.process_index()}.partial")

    def __enter__(self) -> Path:
        return self.partial

    def __exit__(self, kind: Any, *_: Any) -> None:
        if kind is None:
            self.partial.replace(self.path)
        else:
            self.partial.unlink(missing_ok=True)


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """What the chunks are of; None if there are none yet.

    Raises:
        ValueError: this version cannot read it.
    """
    path = folder / MANIFEST
    if not path.exists():
        return None
    manifest = json.loads(path.read_text())
    if manifest.get("format") != FORMAT:
        raise ValueError(f"{folder} has format {manifest.get('format')!r}, and this version reads {FORMAT}")
    return manifest


def finished_chunks(folder: Path, process: int, processes: int) -> set[int]:
    """Chunks of which this process needs to write nothing: its own part is there, or all parts of another number."""
    parts: dict[tuple[int, int], set[int]] = {}
    for path in folder.iterdir() if folder.exists() else ():
        match = _FILE.fullmatch(path.name)
        if match:
            chunk, own, of = (int(part) for part in match.groups(default="-1"))
            parts.setdefault((chunk, of), set()).add(own)
    return {k for (k, of), own in parts.items() if len(own) == abs(of) or (of == processes and process in own)}


@dataclasses.dataclass(frozen=True)
class Saved:
    """Results on disk, of a job that is done or still runs. ``saved[a:b]`` reads lanes a to b, ``saved[:]`` all.

    Only the chunks that hold the lanes wanted are read.

    Attributes:
        folder: where they are.
        like: the structure that they come back in; None: a dict by name.
    """

    folder: Path
    like: Any = None

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Number of lanes, size of chunks, versions, fingerprints of the inputs."""
        found = read_manifest(self.folder)
        if found is None:
            raise FileNotFoundError(f"{self.folder} has no {MANIFEST}: it is no folder of run_in_chunks")
        return found

    def __len__(self) -> int:
        """Number of lanes, also of those that are missing."""
        return self.manifest["count"]

    @property
    def chunks(self) -> int:
        """How many there are when all is done."""
        return -(-len(self) // self.manifest["chunk"])

    @property
    def missing(self) -> tuple[int, ...]:
        """Chunks that are not there."""
        there = {k for k in range(self.chunks) if self._complete(k)}
        return tuple(k for k in range(self.chunks) if k not in there)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the arrays: ``velocity``, ``slack.hand``."""
        for path in sorted(self.folder.glob("*.npz")):
            with np.load(path, allow_pickle=False) as file:
                return tuple(key.removeprefix(_RESULT) for key in file.files if key != _LANES)
        raise ValueError(f"{self.folder} has no finished chunk")

    def __getitem__(self, lanes: slice) -> Any:
        """The results of a slice of lanes: a pytree like ``like``, or a dict by name.

        Raises:
            ValueError: lanes that are missing.
        """
        if not isinstance(lanes, slice):
            raise TypeError(f"lanes are a slice, not {lanes!r}: use [{lanes} : {lanes} + 1]")
        arrays = self.read(self.names, lanes)
        if self.like is None:
            return arrays
        return jax.tree.unflatten(jax.tree.structure(self.like), [arrays[name] for name in leaf_names(self.like)])

    def read(self, names: Sequence[str], lanes: slice = slice(None)) -> dict[str, np.ndarray]:
        """Some of the arrays, by name, of a slice of lanes; nothing else is read.

        Raises:
            KeyError: no such array; the message lists them.
            ValueError: lanes that are missing.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise KeyError(f"no array {unknown[0]!r}; arrays: {', '.join(self.names)}")
        start, stop, step = lanes.indices(len(self))
        if step < 1:
            raise ValueError(f"the step of a slice of lanes is positive, not {step}")
        size = self.manifest["chunk"]
        touched = range(start // size, -(-stop // size)) if stop > start else ()
        parts = [self._chunk(k, names, max(start - k * size, 0), min(stop - k * size, size)) for k in touched]
        if not parts:
            parts = [self._chunk(0, names, 0, 0)]
        return {name: np.concatenate([part[name] for part in parts])[::step] for name in names}

    def _files(self, chunk: int) -> list[Path]:
        """The files that a chunk is in, one set of them where it was written by different numbers of processes."""
        alone = self.folder / f"{chunk:08d}.npz"
        if alone.exists():
            return [alone]
        sets: dict[int, list[Path]] = {}
        for path in sorted(self.folder.glob(f"{chunk:08d}.*-of-*.npz")):
            match = _FILE.fullmatch(path.name)
            if match:
                sets.setdefault(int(match[3]), []).append(path)
        return next((paths for of, paths in sets.items() if len(paths) == of), [])

    def _complete(self, chunk: int) -> bool:
        return bool(self._files(chunk))

    def _chunk(self, chunk: int, names: Sequence[str], start: int, stop: int) -> dict[str, np.ndarray]:
        """Lanes start to stop of a chunk, counted from its first."""
        paths = self._files(chunk)
        if not paths:
            count = len(self.missing)
            raise ValueError(
                f"chunk {chunk} of {self.folder} is missing, with {count - 1} more of {self.chunks}: call "
                "run_in_chunks again, it goes on where it was; if hosts wrote to folders of their own, join them"
            )
        own = min(self.manifest["chunk"], len(self) - chunk * self.manifest["chunk"])
        whole: dict[str, np.ndarray] = {}
        for path in paths:
            with np.load(path, allow_pickle=False) as file:
                blocks = file[_LANES]
                for name in names:
                    _fill(whole, name, file[_RESULT + name], blocks, own)
        return {name: array[start:stop] for name, array in whole.items()}


def _fill(whole: dict[str, np.ndarray], name: str, array: np.ndarray, blocks: np.ndarray, own: int) -> None:
    """Puts the rows of an array where they belong."""
    if name not in whole:
        whole[name] = np.zeros((own, *array.shape[1:]), array.dtype)
    row = 0
    for first, last in blocks.tolist():
        whole[name][first:last] = array[row : row + last - first]
        row += last - first


def load(folder: str | os.PathLike[str], *, like: Any = None) -> Saved:
    """The results that ``run_in_chunks`` wrote, or has written so far.

    Args:
        folder: its ``out``.
        like: a pytree of the structure of the results, whose numbers do not matter (``jax.eval_shape`` makes one).
            Default: they come as a dict by name.

    Raises:
        FileNotFoundError: the folder is none of ``run_in_chunks``.
        ValueError: this version cannot read it, or ``like`` has other arrays.
    """
    saved = Saved(Path(folder), like)
    if like is not None and (len(saved.missing) < saved.chunks) and set(leaf_names(like)) != set(saved.names):
        raise ValueError(f"like has the arrays {', '.join(leaf_names(like))}; saved are {', '.join(saved.names)}")
    len(saved)
    return saved
