"""A progress bar."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def progress_bar(total: int, done: int = 0) -> Iterator[Callable[[int, str], None]]:
    """A bar on the error stream, and a function to tell how many are done and how it goes; "compiling" until then."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (MofNCompleteColumn(), BarColumn(bar_width=30), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=total, completed=done)
        yield lambda completed, description: bar.update(task, completed=completed, description=description)
