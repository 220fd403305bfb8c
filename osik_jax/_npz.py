"""Files of arrays by name, ``.npz``, read without unpickling anything."""

from __future__ import annotations

import contextlib
import os
import zipfile
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.lib.npyio import NpzFile

from ._errors import OsikValueError


@contextlib.contextmanager
def open_npz(path: str | os.PathLike[str]) -> Iterator[NpzFile]:
    """Open a .npz file for reading inside the block; yield its arrays.

    The file is closed whatever happens: ``numpy.load`` leaves one open that is no archive after all.

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it is another kind of file, holds one array or objects, or is damaged, which may show only when an
            array is read.
    """
    name = os.fspath(path)
    with open(path, "rb") as source:
        try:
            file = np.load(source, allow_pickle=False)
            if not isinstance(file, NpzFile):
                raise OsikValueError(f"{name} holds one array and not several by name")
            with file:
                yield file
        except OsikValueError:  # of the block, too
            raise
        except (ValueError, EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            # NumPy takes what it does not know for a pickle, and says how to allow these
            why = "it is none, or holds objects" if "pickle" in str(error) else error
            raise OsikValueError(f"{name} cannot be read as an .npz of plain arrays: {why}") from error
