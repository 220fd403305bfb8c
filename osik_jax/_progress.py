"""A progress bar, times as one says them, and the progress of a job by a bar or by a function of the user."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from ._errors import OsikTypeError

Progress = bool | Callable[[int, int], Any]
"""Display of a job's progress: a bar (True), none (False), or a function of the number of lanes done and of all."""


@contextlib.contextmanager
def progress_bar(total: int, done: int = 0, *, unit: str) -> Iterator[Callable[[int, str], None]]:
    """Draw a bar on the error stream; yield a function that takes the number done and a text.

    The bar says "compiling" until the first call.

    Args:
        total: of how many.
        done: that are done already.
        unit: what they are, in the plural.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    def counted(completed: int) -> str:
        return f"{completed:,} of {total:,} {unit}"

    columns = (TextColumn("{task.fields[counted]}"), BarColumn(bar_width=30), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=total, completed=done, counted=counted(done))
        pace = Pace(done, time.perf_counter())

        def update(completed: int, description: str) -> None:
            seconds = pace.seconds_left(completed, total, time.perf_counter())
            left = f"about {spoken(seconds)} left" if completed < total else ""
            told = ", ".join(part for part in (description, left) if part)
            bar.update(task, completed=completed, counted=counted(completed), description=told)

        yield update


class Pace:
    """Estimate of the remaining time from the pace since the first item, which includes compilation."""

    def __init__(self, done: int, now: float) -> None:
        """Take how many are done already, and the time [s]."""
        self._done, self._then, self._first = done, now, True

    def seconds_left(self, done: int, total: int, now: float) -> float:
        """Return the estimated time for the remaining items [s], when ``done`` items are finished at time ``now``."""
        seconds = (now - self._then) / max(done - self._done, 1) * (total - done)
        if self._first:
            self._done, self._then, self._first = done, now, False
        return seconds


def spoken(seconds: float) -> str:
    """Return a time as one says it: no more exact than it is known."""
    if seconds < 90.0:
        return f"{max(5 * round(seconds / 5.0), 5)} s"
    if seconds < 5400.0:
        return f"{0.5 * round(seconds / 30.0):g} min"
    return f"{0.5 * round(seconds / 1800.0):g} h"


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
