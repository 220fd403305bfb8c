"""Statements of a BVH file with their line numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from .._errors import OsikValueError

_LARGEST = 1e8
"""Largest accepted absolute value of a length in any unit, or of an angle [deg]."""
_KEYWORDS = {"HIERARCHY", "ROOT", "JOINT", "OFFSET", "CHANNELS", "{", "}", "MOTION"}
_MOTION_KEYWORDS = {"FRAMES:", "FRAMES", "FRAME"}


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield each statement with its line number; a line may hold several statements, and a statement may span lines.

    A statement of the tree starts with a keyword. Behind MOTION each line of numbers is one.
    """
    statement: list[str] = []
    began, lines = 1, iter(enumerate(text.splitlines(), 1))
    for number, line in lines:
        words = line.replace("{", " { ").replace("}", " } ").split()
        for i, word in enumerate(words):
            # names may have spaces and keywords in them, up to the end of their line
            in_name = bool(statement) and statement[0].upper() in ("ROOT", "JOINT") and number == began
            keyword = word.upper() in _KEYWORDS or [w.upper() for w in words[i : i + 2]] == ["END", "SITE"]
            if not statement or word in ("{", "}") or (keyword and not in_name):
                if statement:
                    yield began, statement
                statement, began = [], number
            statement.append(word)
            if statement == [word] and word.upper() == "MOTION":
                yield number, statement
                yield from _behind_motion(itertools.chain([(number, " ".join(words[i + 1 :]))], lines))
                return
    if statement:
        yield began, statement


def _behind_motion(lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Yield the statements after MOTION: the number of frames, the frame time, and one row of numbers per frame."""
    for number, line in lines:
        words = line.split()
        starts = [i for i, word in enumerate(words) if word.upper() in _MOTION_KEYWORDS]
        for start, end in itertools.pairwise([0, *starts, len(words)]):
            part = words[start:end]
            size = 3 if [word.upper().rstrip(":") for word in part[:2]] == ["FRAME", "TIME"] else len(part)
            yield from ((number, some) for some in (part[:size], part[size:]) if some)


class Lines:
    """Iterator over the statements of a BVH file; its errors name the line."""

    def __init__(self, path: str, text: str):
        self.path, self._lines, self._at = path, list(_statements(text)), 0

    def next(self, expected: str) -> list[str]:
        """Return the words of the next statement."""
        if self._at == len(self._lines):
            raise OsikValueError(f"{self.path} ends where {expected} should come")
        self._at += 1
        return self._lines[self._at - 1][1]

    def rewrap(self, columns: int, count: int) -> None:
        """Split the remaining ``count * columns`` numbers into rows of ``columns``, wherever the file's lines end."""
        left = [(number, word) for number, words in self._lines[self._at :] for word in words]
        even = all(len(words) == columns for _, words in self._lines[self._at :])
        if not even and len(left) == count * columns:
            rows = (left[i : i + columns] for i in range(0, len(left), columns))
            self._lines[self._at :] = [(row[0][0], [word for _, word in row]) for row in rows]

    def error(self, what: str) -> ValueError:
        """Return an error that names the line read last."""
        number, words = self._lines[max(self._at - 1, 0)] if self._lines else (1, [])
        return OsikValueError(f"{self.path}, line {number}: {what}; the line is {' '.join(words)[:60]!r}")

    def rest(self) -> Iterator[list[str]]:
        """Yield the words of each remaining statement."""
        while self._at < len(self._lines):
            yield self.next("a frame")

    def numbers(self, words: list[str], count: int, what: str) -> list[float]:
        """Return words as ``count`` finite numbers, or raise ValueError that names the line read last."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise self.error(f"{what} is not numbers") from None
        if len(values) != count:
            raise self.error(f"{what} has {len(values)} numbers where there should be {count}")
        if not np.isfinite(values).all():
            raise self.error(f"{what} is not finite")
        if max(map(abs, values), default=0.0) > _LARGEST:
            raise self.error(f"{what} has a number over {_LARGEST:g}, which is no length and no angle")
        return values
