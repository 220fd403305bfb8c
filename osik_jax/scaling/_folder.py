"""Folder of a job: one job at a time works in it, and it is new, of another job, or has finished chunks of this one."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import socket
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .._errors import OsikValueError
from ._chunk_file import DamagedFile, Part, check_chunk, chunk_files, complete, unwritable
from ._fingerprint import differences
from ._saved import read_manifest, write_manifest

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems that know no locks."""


def claim(folder: Path, manifest: Mapping[str, Any], process: int, processes: int) -> dict[int, list[Part]]:
    """Assign a folder to a job, and check that every finished chunk is complete and of this job.

    Damaged files are removed, with a warning, so that they are made anew. Return the chunks of which this process needs
    to write nothing, each with parts that it has checked: its own part is there, or all parts of another number of
    processes. No other job writes to the folder.
    """
    old = _old_manifest(folder)
    changed = [line for line in differences(old or manifest, manifest) if not line.startswith("job was")]
    if changed:
        raise OsikValueError(f"{folder} has another job in it; name another folder. What differs: {'; '.join(changed)}")
    found = _undamaged(folder, manifest["job"], process, processes)
    if old is None:
        write_manifest(folder, manifest)
    own = {part.chunk: [part] for part in found if part.processes == processes}
    return complete(part for part in found if part.processes != processes) | own


def _old_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the existing manifest; None if it is damaged, because each chunk has its job's identifier."""
    try:
        return read_manifest(folder)
    except DamagedFile as damaged:
        _report(damaged)
        return None


def _undamaged(folder: Path, job: str, process: int, processes: int) -> list[Part]:
    """Return this process's parts and those of other numbers of processes; damaged ones are removed."""
    parts = [part for part in chunk_files(folder) if part.processes != processes or part.process == process]

    def damage(part: Part) -> DamagedFile | None:
        try:
            check_chunk(folder / part.file_name, part, job)
        except DamagedFile as damaged:
            return damaged
        return None

    with ThreadPoolExecutor() as pool:
        damages = list(pool.map(damage, parts))
    for part, damaged in zip(parts, damages, strict=True):
        if damaged is not None:
            _report(damaged)
            (folder / part.file_name).unlink(missing_ok=True)
    return [part for part, damaged in zip(parts, damages, strict=True) if damaged is None]


def _report(damaged: DamagedFile) -> None:
    warnings.warn(f"{damaged.found}; it is made anew", stacklevel=6)


def check_space(folder: Path, needed: int) -> None:
    """Raise OSError where results of ``needed`` bytes do not fit into a folder."""
    disk = shutil.disk_usage(folder)
    if disk.total and disk.free < needed:  # some network file systems say 0 of 0
        message = (
            f"the results that are missing take {_size(needed)}, and the folder's disk has {_size(disk.free)} left"
        )
        raise OSError(errno.ENOSPC, message, str(folder))


def _size(count: int) -> str:
    return f"{count / 2**30:,.1f} GiB" if count >= 2**30 else f"{count / 2**20:,.1f} MiB"


@contextlib.contextmanager
def only_job(folder: Path, process: int = 0) -> Iterator[bool]:
    """Make the folder, and lock it against other jobs inside the block.

    The operating system holds the lock for the process and drops it when the process ends, however it ends. So the lock
    file, which stays in the folder, stops nobody. The block is given whether the others are kept out; some file systems
    know no locks.
    """
    from filelock import FileLock, Timeout  # a tenth of a second, which jobs in memory need not wait for

    name, alone = f".lock.{process}" if process else ".lock", True
    lock, owner = FileLock(folder / name, timeout=0), folder / f"{name}.owner"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
        owner.write_text(f"process {os.getpid()} on {socket.gethostname()}")
    except Timeout as error:
        message = f"{_read(owner)} works in the folder; wait until it ends, or name another folder"
        raise BlockingIOError(errno.EWOULDBLOCK, message, str(folder)) from error
    except OSError as error:
        alone = False
        if error.errno not in _NO_LOCKS:
            lock.release()
            raise unwritable(folder, "the folder for the results cannot be made or written to", error) from error
    try:
        yield alone
    finally:
        if alone:
            owner.unlink(missing_ok=True)
            lock.release()


def _read(owner: Path) -> str:
    """Return the owner of a lock, as its file names it."""
    with contextlib.suppress(OSError):  # it has not written its name yet, or ends just now
        return owner.read_text() or "another process"
    return "another process"
