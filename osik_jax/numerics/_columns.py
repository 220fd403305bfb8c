"""Tables of numbers in CSV files."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError


def read_columns(
    path: str | os.PathLike[str], unnamed: Sequence[str] = (), used: Callable[[str], bool] = bool
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the finite numbers of a CSV file by the names of its columns; lines that begin with # are left out.

    The head names the columns; ``unnamed`` does so for a file that begins with numbers. Lines without any number, and
    empty cells behind the last column, are those of a spreadsheet. Columns whose names are not ``used`` may hold
    anything.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = [(number, row) for number, row in enumerate(csv.reader(file), 1) if _says_something(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise OsikValueError(f"{path} is no table in UTF-8: {error}") from None
    if unnamed and lines and not np.isnan(as_number(lines[0][1][0])):
        lines = [(0, list(unnamed[: len(lines[0][1])])), *lines]
    names = [name.strip() for name in lines[0][1]] if lines else []
    while names and not names[-1]:
        names.pop()
    places = [k for k, name in enumerate(names) if used(name) or not name]
    taken = [names[k] for k in places]
    if len(lines) < 2 or len(set(taken)) < len(taken):
        raise OsikValueError(f"{path}: a head with different names and at least one line of numbers are expected")
    table = np.array([_numbers(f"{path}, line {number}", row, names, places) for number, row in lines[1:]])
    return dict(zip(taken, table.T, strict=True))


def _says_something(row: Sequence[str]) -> bool:
    return any(cell.strip() for cell in row) and not row[0].startswith("#")


def _numbers(where: str, row: Sequence[str], names: Sequence[str], places: Sequence[int]) -> list[float]:
    """Return the numbers of a line at some places; ``where`` names it in messages."""
    if len(row) < len(names) or any(cell.strip() for cell in row[len(names) :]):
        raise OsikValueError(
            f"{where}: {len(row)} values, but there are {len(names)} headings; each line has {len(names)} numbers"
        )
    values = [as_number(row[k]) for k in places]
    for k, value in zip(places, values, strict=True):
        if not np.isfinite(value):
            raise OsikValueError(
                f"{where}, column {names[k]}: {row[k]!r} is no finite number; each line has {len(names)} numbers"
            )
    return values


def as_number(word: str) -> float:
    """Return a word as a number; NaN if it is none."""
    try:
        return float(word)
    except ValueError:
        return np.nan
