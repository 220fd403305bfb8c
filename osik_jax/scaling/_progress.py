"""Progress of a job, by a bar or a user's function."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from .._errors import OsikTypeError
from .._progress import progress_bar

Progress = bool | Callable[[int, int], Any]
"""Whether to show a bar; or a function of the lanes that are done and of all."""


def check_progress(progress: Any) -> None:
    """Raise TypeError unless the value is True, False or a function."""
    if not isinstance(progress, bool) and not callable(progress):
        raise OsikTypeError(f"progress is {progress!r}; it is True, False, or a function of the lanes done and of all")


@contextlib.contextmanager
def reported(total: int, done: int, progress: Progress, unit: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of lanes newly done.

    It draws a bar with that label, or calls a given function.
    """
    with contextlib.ExitStack() as stack:
        update = stack.enter_context(progress_bar(total, done, unit=unit)) if progress is True else None
        start, own = time.perf_counter(), 0

        def advance(more: int) -> None:
            nonlocal own
            own += more
            if update is not None:
                rate = own / (time.perf_counter() - start)
                update(done + own, f"{rate:,.0f} a second" if rate >= 10.0 else f"{rate:.2g} a second")
            elif callable(progress):
                progress(done + own, total)

        yield advance
