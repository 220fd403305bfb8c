"""Tables of numbers in CSV files."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError


def read_columns(path: str | os.PathLike[str], unnamed: Sequence[str] = ()) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the numbers of a CSV file by the names of its columns; lines that begin with # are left out.

    The head names the columns; ``unnamed`` does so for a file that begins with numbers.
    """
    with open(path, newline="", encoding="utf-8") as file:
        head, *lines = [row for row in csv.reader(file) if row and not row[0].startswith("#")] or [[]]
    if unnamed and _are_numbers(head):
        head, lines = list(unnamed[: len(head)]), [head, *lines]
    names = [name.strip() for name in head]
    if not lines or len(set(names)) < len(names):
        raise OsikValueError(f"{path}: a head with different names and at least one line of numbers are expected")
    try:
        table = np.array([[float(cell) for cell in line] for line in lines])
        return dict(zip(names, table.T, strict=True))
    except ValueError as error:
        raise OsikValueError(f"{path}: {error}; each line has {len(names)} numbers") from None


def _are_numbers(cells: Sequence[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False
