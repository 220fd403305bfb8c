"""Lock that admits one job at a time to a folder."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from ._chunk_file import unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


@contextlib.contextmanager
def only_job(folder: Path, process: int = 0) -> Iterator[bool]:
    """Make the folder, and lock it against other jobs inside the block.

    The operating system holds the lock for the process and drops it when the process ends, however it ends. So a lock
    file that a killed job left behind stops nobody.

    Args:
        folder: where the results go.
        process: index of this process in its job.

    Yields:
        Whether the others are kept out; some file systems know no locks.

    Raises:
        BlockingIOError: another process has the folder; the message names it.
        OSError: the folder cannot be made or written to.
    """
    path = folder / (f".lock.{process}" if process else ".lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _taken(path)
    except BlockingIOError as error:
        message = f"{_owner(path)} works in the folder; wait until it ends, or name another folder"
        raise BlockingIOError(errno.EWOULDBLOCK, message, str(folder)) from error
    except OSError as error:
        raise unwritable(folder, "the folder for the results cannot be made or written to", error) from error
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            os.close(descriptor)


def _taken(path: Path) -> int | None:
    """Return the descriptor of the locked file, None if it cannot be locked here."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            locked = _locked(descriptor)
            if locked and _is_at(descriptor, path):  # else the one before us has just removed it
                _sign(descriptor)
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if not locked:
            path.unlink(missing_ok=True)
            return None


def _sign(descriptor: int) -> None:
    """Write the owner of the lock to its file."""
    os.ftruncate(descriptor, 0)
    os.write(descriptor, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
    os.fsync(descriptor)


def _locked(descriptor: int) -> bool:
    """Lock a file; False if the file system cannot.

    Raises:
        BlockingIOError: another process has locked it.
    """
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return False
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _owner(path: Path) -> str:
    """Return the owner of a lock, as its file names it."""
    try:
        found = json.loads(path.read_text())
        return f"process {found['pid']} on {found['host']}"
    except (OSError, ValueError, TypeError, KeyError):  # it has not written its name yet, or ends just now
        return "another process"
