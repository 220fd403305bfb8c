"""Folder of a job, in which one job works at a time."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems that know no locks."""


@contextlib.contextmanager
def only_job(folder: Path) -> Iterator[None]:
    """Make the folder, and lock it against other jobs inside the block.

    The operating system drops the lock when the process ends, however it ends. So the lock file, which stays in the
    folder, stops nobody. On a file system without locks, nobody is kept out.

    Raises:
        BlockingIOError: another process works in the folder.
        OSError: the folder cannot be made or written to.
    """
    from filelock import FileLock, Timeout  # a tenth of a second, which jobs in memory need not wait for

    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        message = "another process works in the folder; wait until it ends, or name another folder"
        raise BlockingIOError(errno.EWOULDBLOCK, message, str(folder)) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    try:
        yield
    finally:
        lock.release()
