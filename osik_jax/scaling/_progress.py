"""A bar with the lanes done."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from .._progress import progress_bar


@contextlib.contextmanager
def reported(total: int, done: int, *, shown: bool) -> Iterator[Callable[[int], None]]:
    """A function to tell how many more lanes are done; it draws a bar if wanted."""
    if not shown:
        yield lambda more: None
        return
    with progress_bar(total, done) as update:
        start, own = time.perf_counter(), [0]

        def advance(more: int) -> None:
            own[0] += more
            rate = own[0] / (time.perf_counter() - start)
            update(done + own[0], f"{rate:,.0f} lanes/s")

        yield advance
