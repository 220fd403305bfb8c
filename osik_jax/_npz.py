"""Files of arrays by name, ``.npz``, read without unpickling anything."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import numpy as np
from numpy.lib.npyio import NpzFile

from ._errors import OsikValueError


@contextlib.contextmanager
def open_npz(path: str | os.PathLike[str]) -> Iterator[NpzFile]:
    """The arrays of a file, to be read inside the block.

    The file is closed whatever happens: ``numpy.load`` leaves one open that is no archive after all.

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it holds one array, or objects.
        zipfile.BadZipFile, EOFError: it is damaged; reading an array may raise these as well.
    """
    with open(path, "rb") as source:
        file = np.load(source, allow_pickle=False)
        if not isinstance(file, NpzFile):
            raise OsikValueError(f"{os.fspath(path)} holds one array and not several by name")
        with file:
            yield file
