"""Lock that admits one job at a time to a folder."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from ._chunk_file import unwritable

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems that know no locks."""


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
