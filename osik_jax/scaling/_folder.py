"""Check of a job's folder: new, of another job, or with finished chunks of this job."""

from __future__ import annotations

import errno
import shutil
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .._errors import OsikValueError
from ._chunk_file import DamagedFile, Part, check_chunk, chunk_files, complete
from ._fingerprint import differences
from ._saved import read_manifest, write_manifest


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
