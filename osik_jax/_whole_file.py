"""Files that get their name only when they are complete."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing bytes inside the block; it replaces an older one only if all goes well.

    Raises:
        OSError: the file cannot be written. An older file of this name is unchanged.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # a device or a pipe must not be replaced
        with path.open("wb") as file:
            yield file
        return
    target = path.resolve()  # a symbolic link stays one
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # before the new name: a power failure must not leave an empty file under it
        if target.exists():
            shutil.copymode(target, partial)
        partial.replace(target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            code = error.errno or errno.EIO
            raise OSError(code, f"it cannot be written: {os.strerror(code)}", os.fspath(path)) from error
        raise


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8, as ``whole_file`` does."""
    with whole_file(path) as file:
        file.write(text.encode())
