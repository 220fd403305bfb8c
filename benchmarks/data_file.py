"""Tables of measurements: CSV files in docs/data, and short tables between two marks of a page."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
DATA = DOCS / "data"


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table as a CSV file, its column names first."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        table.writerows(rows)


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the column names and the rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return head, rows


def write_between(text: str, path: Path, *, start: str, end: str) -> None:
    """Replace the text between two marks of a page."""
    page = path.read_text(encoding="utf-8")
    before, after = page[: page.index(start) + len(start)], page[page.index(end) :]
    path.write_text(f"{before}\n{text}\n{after}", encoding="utf-8")
