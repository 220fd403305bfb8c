"""File of a chunk: arrays in a plain ``.npz``, with the identifiers of its job and chunk."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from .._errors import OsikValueError
from .._npz import open_npz
from .._whole_file import whole_file

_RESULT = "result."
_JOB, _PART, _NAMES, _LANES = "job", "part", "names", "lanes"
_FILE = re.compile(r"(\d{8,})(?:\.(\d+)-of-(\d+))?\.npz")

Block = tuple[int, int]
"""First lane, and the one after the last, counted within the chunk."""


class DamagedFile(OsikValueError):
    """A file cannot be read, or holds something else than its name says.

    Attributes:
        found: which file, and what is wrong with it.
    """

    def __init__(self, path: Path, wrong: str):
        self.found = f"{path} {wrong}"
        super().__init__(f"{self.found}; call run_in_chunks again with the same arguments, it makes the file anew")


class OtherJob(OsikValueError):
    """A file has results of another job."""


class Part(NamedTuple):
    """Lanes of a chunk that one of several processes has; a single process has all of them."""

    chunk: int
    process: int = 0
    processes: int = 1

    @property
    def file_name(self) -> str:
        """Return the name of the file that the part is kept in."""
        own = f".{self.process}-of-{self.processes}" if self.processes > 1 else ""
        return f"{self.chunk:08d}{own}.npz"

    @classmethod
    def of(cls, path: Path) -> Part | None:
        """Return the part that a file name stands for, or None."""
        match = _FILE.fullmatch(path.name)
        part = cls(*(int(number) for number in match.groups() if number is not None)) if match else None
        return part if part and part.file_name == path.name else None


def chunk_files(folder: Path) -> dict[Part, Path]:
    """Return all files of chunks in a folder, in order."""
    found = {part: path for path in folder.iterdir() if (part := Part.of(path))} if folder.is_dir() else {}
    return dict(sorted(found.items()))


def complete(parts: Iterable[Part]) -> dict[int, list[Part]]:
    """Return the complete chunks, each with one set of parts if runs with different numbers of processes wrote it."""
    sets: dict[tuple[int, int], list[Part]] = {}
    for part in sorted(parts):
        sets.setdefault((part.chunk, part.processes), []).append(part)
    return {k: own for (k, processes), own in sorted(sets.items(), reverse=True) if len(own) == processes}


def write_chunk(folder: Path, part: Part, job: str, blocks: Sequence[Block], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the results of some lanes.

    ``blocks`` are the ranges of lanes that the rows of the arrays are; arrays have the lanes in front.

    Raises:
        OSError: the file cannot be written.
        ValueError: an array is of a type that a ``.npz`` does not keep.
    """
    for name, array in arrays.items():
        _check_type(name, array.dtype)
    marks = {
        _JOB: np.array(job),
        _PART: np.array(part, np.int64),
        _NAMES: np.array(list(arrays)),
        _LANES: np.array(blocks, np.int64).reshape(-1, 2),
    }
    named = {_RESULT + name: array for name, array in arrays.items()}
    with job_file(folder / part.file_name) as file:
        np.savez(file, allow_pickle=False, **marks, **named)


def _check_type(name: str, dtype: np.dtype) -> None:
    """Raise TypeError for types that ``.npz`` does not keep without pickle, such as objects and bfloat16."""
    known = not dtype.hasobject and np.dtype(dtype.str) == dtype
    if not known and dtype.names is None:
        raise OsikValueError(f"{name or 'the result'} is of type {dtype}, which no .npz keeps; NumPy's own numbers do")


@contextlib.contextmanager
def job_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file of a job for writing inside the block, as ``whole_file`` does; errors say how to continue the job."""
    try:
        with whole_file(path) as file:
            yield file
    except OSError as error:
        raise unwritable(path.parent, f"{path.name} cannot be written", error) from error


def remove_partial_files(folder: Path) -> None:
    """Remove partial files of killed processes; no other process may be writing."""
    for path in folder.glob(".*.npz.*.partial"):
        path.unlink(missing_ok=True)


def unwritable(folder: Path, what: str, error: OSError) -> OSError:
    """Return an error of the same type that names the folder and states how to continue the job."""
    code = error.errno or errno.EIO
    message = f"{what}: {os.strerror(code)}; chunks that are finished stay, call again when this is cured"
    return OSError(code, message, str(folder))


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading inside the block; yield its arrays."""
    try:
        with open_npz(path) as file:
            yield file
    except (DamagedFile, OtherJob, MemoryError):
        raise
    except Exception as error:  # whatever the bytes of a damaged file lead zipfile and NumPy to
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise DamagedFile(path, f"is damaged ({error})") from error


def check_chunk(path: Path, part: Part, job: str) -> None:
    """Read a file once, against its checksums."""
    with opened(path) as file:
        broken = file.zip.testzip()
        if broken is not None:
            raise DamagedFile(path, f"is damaged (the checksum of {broken} is wrong)")
        _check_marks(file, path, part, job)


def read_chunk(
    path: Path, part: Part, job: str, names: Sequence[str] | None = None
) -> tuple[list[Block], dict[str, np.ndarray]]:
    """Return the lanes that a file has, and some of its arrays by name, or all."""
    with opened(path) as file:
        _check_marks(file, path, part, job)
        wanted = result_names(file) if names is None else names
        return [(a, b) for a, b in file[_LANES].tolist()], {name: file[_RESULT + name] for name in wanted}


def result_names(file: Any) -> tuple[str, ...]:
    """Return the names of the results in an opened file."""
    return tuple(file[_NAMES].tolist())


def _check_marks(file: Any, path: Path, part: Part, job: str) -> None:
    """Raise where a file is not of this part of this job, or where a damaged directory hides some of its arrays."""
    if file.files and (_JOB not in file.files or str(file[_JOB]) != job):
        raise OtherJob(f"{path} has results of another job; name another folder, or take the file out of this one")
    found = Part(*file[_PART].tolist())
    if found != part:
        raise DamagedFile(path, f"has the content of {found.file_name}")
    hidden = {_LANES, *(_RESULT + name for name in result_names(file))}.difference(file.files)
    if hidden:
        raise DamagedFile(path, f"is damaged ({min(hidden)} is not in its directory)")
