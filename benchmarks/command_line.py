"""What the command lines of the benchmarks share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection
from typing import Any


def listed(kind: Callable[[str], Any], among: Collection[str] = ()) -> Callable[[str], list[Any]]:
    """Parser of a list with commas."""

    def parse(text: str) -> list[Any]:
        values = [kind(part) for part in text.split(",")]
        wrong = [value for value in values if among and value not in among]
        if wrong:
            raise argparse.ArgumentTypeError(f"{wrong[0]!r} is none of {', '.join(among)}")
        return values

    return parse
