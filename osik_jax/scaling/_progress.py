"""A bar with the lanes done."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def reported(total: int, done: int, *, shown: bool) -> Iterator[Callable[[int], None]]:
    """A function to tell how many more lanes are done; it draws a bar if wanted."""
    if not shown:
        yield lambda more: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (MofNCompleteColumn(), BarColumn(bar_width=30), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=total, completed=done)
        start, own = time.perf_counter(), [0]

        def advance(more: int) -> None:
            own[0] += more
            rate = own[0] / (time.perf_counter() - start)
            bar.update(task, advance=more, description=f"{rate:,.0f} lanes/s")

        yield advance
