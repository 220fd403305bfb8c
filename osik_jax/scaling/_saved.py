"""Results in a folder: a ``.npz`` file for each chunk, and a manifest of the job."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikKeyError, OsikTypeError, OsikValueError, warn
from .._npz import open_npz
from .._whole_file import whole_file, write_text
from ._fingerprint import differences, identifier

FORMAT = 3
_MANIFEST = "manifest.json"
_RESULT, _MARK = "result.", "of"
"""Name of a result in a file begins so; name of the array with the identifier of the job, the chunk and the results."""


class _DamagedChunk(OsikValueError):
    """A chunk's file cannot be read, or has other arrays than were written."""


@dataclasses.dataclass(frozen=True)
class Saved:
    """Results on disk of a finished or running job. ``saved[a:b]`` reads lanes a to b, ``saved[:]`` all.

    Arrays come by name, such as ``velocity`` and ``slack.hand``. Only the chunks that hold the lanes are read.

    Attributes:
        folder: where they are.
        manifest: number of lanes, size of chunks, versions, fingerprints of the inputs.
    """

    folder: Path
    manifest: Mapping[str, Any]

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
        return tuple(k for k in range(self.chunks) if not self._path(k).exists())

    def __getitem__(self, lanes: slice) -> dict[str, np.ndarray]:
        """Return all arrays of a slice of lanes; exceptions are those of ``read``."""
        return self.read(None, lanes)

    def read(self, names: Sequence[str] | None, lanes: slice = slice(None)) -> dict[str, np.ndarray]:
        """Return some of the arrays, by name, of a slice of lanes; None: all arrays.

        Raises:
            KeyError: no such array; the message lists them.
            TypeError: the lanes are no slice.
            ValueError: lanes that are missing, a damaged file, or a slice with a step.
        """
        if not isinstance(lanes, slice):
            raise OsikTypeError(f"lanes are a slice, not {lanes!r}: use [{lanes} : {lanes} + 1]")
        start, stop, step = lanes.indices(len(self))
        if step != 1:
            raise OsikValueError(f"the step of a slice of lanes is 1, not {step}")
        size = self.manifest["chunk"]
        touched = range(start // size, -(-stop // size)) or range(1)
        parts = [self._chunk(k, names) for k in touched]
        first = touched[0] * size
        return {
            name: np.concatenate([part[name] for part in parts])[start - first : max(start, stop) - first]
            for name in parts[0]
        }

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a chunk; its file gets its name when it is complete."""
        for name, array in arrays.items():
            if array.dtype.hasobject or (array.dtype.names is None and np.dtype(array.dtype.str) != array.dtype):
                raise OsikValueError(f"{name or 'the result'} is of type {array.dtype}, which no .npz keeps")
        named: dict[str, Any] = {_RESULT + name: array for name, array in arrays.items()}
        named[_MARK] = np.array([identifier(self.manifest), str(chunk), *arrays])
        with whole_file(self._path(chunk)) as file:
            np.savez(file, allow_pickle=False, **named)

    def claim(self) -> list[int]:
        """Assign the folder to the job; return the chunks to run: missing ones, and damaged ones, which are removed."""
        old = _read_manifest(self.folder)
        if old is None and any(self.folder.glob("[0-9]*.npz")):
            raise OsikValueError(f"{self.folder} has chunks of a job without its {_MANIFEST}; name another folder")
        changed = differences(old or self.manifest, self.manifest)
        if changed:
            what = "; ".join(changed)
            raise OsikValueError(f"{self.folder} has another job in it; name another folder. What differs: {what}")
        for partial in self.folder.glob(".*.npz.*.partial"):  # of processes that were killed
            partial.unlink(missing_ok=True)
        if old is None:
            write_text(self.folder / _MANIFEST, json.dumps(self.manifest, indent=1))
        return [k for k in range(self.chunks) if not self._is_whole(k)]

    def _is_whole(self, chunk: int) -> bool:
        """Return whether a chunk is there; read it against its checksums, and remove it if it is damaged."""
        if not self._path(chunk).exists():
            return False
        try:
            self._chunk(chunk, None)
        except _DamagedChunk as damaged:
            warn(f"{str(damaged).partition(';')[0]}; it is made anew")
            self._path(chunk).unlink()
            return False
        return True

    def _path(self, chunk: int) -> Path:
        return self.folder / f"{chunk:08d}.npz"

    def _chunk(self, chunk: int, names: Sequence[str] | None) -> dict[str, np.ndarray]:
        """Return arrays of a chunk by name."""
        again = "call run_in_chunks again with the same arguments"
        if not self._path(chunk).exists():
            more = len(self.missing) - 1
            raise OsikValueError(
                f"chunk {chunk} of {self.folder} is missing, with {more} more of {self.chunks}; {again}, it goes on "
                "where it was"
            )
        path = self._path(chunk)
        try:
            with open_npz(path) as file:
                job, number, *known = file[_MARK].tolist() if _MARK in file.files else ("", "")
                if number != str(chunk) or {_MARK, *(_RESULT + name for name in known)} != set(file.files):
                    raise OsikValueError(f"{path} has not the arrays of chunk {chunk}")
                unknown = [name for name in names or () if name not in known]
                if job == identifier(self.manifest) and not unknown:
                    return {name: file[_RESULT + name] for name in (known if names is None else names)}
        except ValueError as error:
            raise _DamagedChunk(f"{error}; {again}, it makes the file anew") from error
        if job != identifier(self.manifest):
            raise OsikValueError(f"{path} has results of another job; take it out of the folder")
        raise OsikKeyError(f"no array {unknown[0]!r}; arrays: {', '.join(known)}")


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a folder; None if there is none."""
    path = folder / _MANIFEST
    if not path.exists():
        return None
    try:
        manifest = json.loads(path.read_bytes())
        form = manifest["format"]
    except (ValueError, TypeError, KeyError) as error:
        raise OsikValueError(f"{path} is damaged ({error}); name another folder") from error
    if form != FORMAT:
        raise OsikValueError(
            f"{folder} has format {form!r}, and this version reads and writes {FORMAT}: name another folder for a job; "
            "np.load opens the files of this one"
        )
    return manifest


def load(folder: str | os.PathLike[str]) -> Saved:
    """Return the results that ``run_in_chunks`` wrote, or has written so far.

    Args:
        folder: its ``out``.

    Raises:
        FileNotFoundError: the folder was not written by ``run_in_chunks``.
        ValueError: this version cannot read it.
    """
    manifest = _read_manifest(Path(folder))
    if manifest is None:
        raise FileNotFoundError(f"{folder} has no {_MANIFEST}: it is no folder of run_in_chunks")
    return Saved(Path(folder), manifest)
