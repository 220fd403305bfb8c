"""Results in a folder: a file for each chunk, and a manifest of the job."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._errors import OsikKeyError, OsikTypeError, OsikValueError
from ..batching._names import leaf_names
from ._chunk_file import DamagedFile, Part, chunk_files, complete, job_file, opened, read_chunk, result_names
from ._fingerprint import identifier

FORMAT = 2
MANIFEST = "manifest.json"


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest."""
    with job_file(folder / MANIFEST) as file:
        file.write(json.dumps(manifest, indent=1).encode())


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a folder; None if there is none."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        manifest = json.loads(path.read_bytes())
        form = manifest["format"]
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedFile(path, f"is damaged ({error})") from error
    if form != FORMAT:
        raise OsikValueError(
            f"{folder} has format {form!r}, and this version reads and writes {FORMAT}: name another folder for a job; "
            "np.load opens the files of this one"
        )
    if manifest.get("job") != identifier(manifest):
        raise DamagedFile(path, "is damaged (its checksum, called job, is wrong)")
    return manifest


@dataclasses.dataclass(frozen=True)
class Saved:
    """Results on disk of a finished or running job. ``saved[a:b]`` reads lanes a to b, ``saved[:]`` all.

    Only the chunks that hold the lanes wanted are read.

    Attributes:
        folder: where they are.
        like: the structure that they come back in; None: a dict by name.
    """

    folder: Path
    like: Any = None

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Return the number of lanes, size of chunks, versions, fingerprints of the inputs."""
        found = read_manifest(self.folder)
        if found is None:
            raise FileNotFoundError(f"{self.folder} has no {MANIFEST}: it is no folder of run_in_chunks")
        return found

    def __len__(self) -> int:
        """Return the number of lanes, including missing ones."""
        return self.manifest["count"]

    @property
    def chunks(self) -> int:
        """Return the number of chunks of the finished job."""
        return -(-len(self) // self.manifest["chunk"])

    @property
    def missing(self) -> tuple[int, ...]:
        """Return the indices of missing chunks."""
        there = complete(chunk_files(self.folder))
        return tuple(k for k in range(self.chunks) if k not in there)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of the arrays, such as ``velocity`` and ``slack.hand``."""
        for path in chunk_files(self.folder).values():
            with opened(path) as file:
                return result_names(file)
        raise OsikValueError(f"{self.folder} has no finished chunk")

    def __getitem__(self, lanes: slice) -> Any:
        """Return the results of a slice of lanes: a pytree like ``like``, or a dict by name.

        Raises:
            ValueError: lanes that are missing.
        """
        if not isinstance(lanes, slice):
            raise OsikTypeError(f"lanes are a slice, not {lanes!r}: use [{lanes} : {lanes} + 1]")
        arrays = self.read(self.names, lanes)
        if self.like is None:
            return arrays
        return jax.tree.unflatten(jax.tree.structure(self.like), [arrays[name] for name in leaf_names(self.like)])

    def read(self, names: Sequence[str], lanes: slice = slice(None)) -> dict[str, np.ndarray]:
        """Return some of the arrays, by name, of a slice of lanes; nothing else is read.

        Raises:
            KeyError: no such array; the message lists them.
            ValueError: lanes that are missing.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise OsikKeyError(f"no array {unknown[0]!r}; arrays: {', '.join(self.names)}")
        start, stop, step = lanes.indices(len(self))
        if step < 1:
            raise OsikValueError(f"the step of a slice of lanes is positive, not {step}")
        size = self.manifest["chunk"]
        touched = range(start // size, -(-stop // size)) if stop > start else ()
        parts = [self._chunk(k, names, max(start - k * size, 0), min(stop - k * size, size)) for k in touched]
        if not parts:
            parts = [self._chunk(0, names, 0, 0)]
        return {name: np.concatenate([part[name] for part in parts])[::step] for name in names}

    def _parts(self, chunk: int) -> list[Part]:
        """Return the parts of a chunk: one set of them if different numbers of processes wrote it."""
        alone = Part(chunk)
        if (self.folder / alone.file_name).exists():
            return [alone]
        paths = self.folder.glob(f"{chunk:08d}.*-of-*.npz")
        return complete(part for path in paths if (part := Part.of(path))).get(chunk, [])

    def _chunk(self, chunk: int, names: Sequence[str], start: int, stop: int) -> dict[str, np.ndarray]:
        """Return lanes start to stop of a chunk, counted from its first."""
        parts = self._parts(chunk)
        if not parts:
            count = len(self.missing)
            raise OsikValueError(
                f"chunk {chunk} of {self.folder} is missing, with {count - 1} more of {self.chunks}: call "
                "run_in_chunks again, it goes on where it was; if hosts wrote to folders of their own, join them"
            )
        job = self.manifest["job"]
        read = [read_chunk(self.folder / part.file_name, part, job, names) for part in parts]
        own = min(self.manifest["chunk"], len(self) - chunk * self.manifest["chunk"])
        lanes = np.concatenate([np.arange(*block) for blocks, _ in read for block in blocks])
        if not np.array_equal(np.sort(lanes), np.arange(own)):
            raise DamagedFile(self.folder / parts[0].file_name, f"and its like do not have each of {own} lanes once")
        wanted = np.argsort(lanes)[start:stop]
        return {name: np.concatenate([arrays[name] for _, arrays in read])[wanted] for name in names}


def load(folder: str | os.PathLike[str], *, like: Any = None) -> Saved:
    """Return the results that ``run_in_chunks`` wrote, or has written so far.

    Args:
        folder: its ``out``.
        like: a pytree of the structure of the results, whose numbers do not matter (``jax.eval_shape`` makes one).
            Default: they come as a dict by name.

    Raises:
        FileNotFoundError: the folder was not written by ``run_in_chunks``.
        ValueError: this version cannot read it, or ``like`` has other arrays.
    """
    saved = Saved(Path(folder), like)
    if like is not None and (len(saved.missing) < saved.chunks) and set(leaf_names(like)) != set(saved.names):
        raise OsikValueError(f"like has the arrays {', '.join(leaf_names(like))}; saved are {', '.join(saved.names)}")
    len(saved)
    return saved
