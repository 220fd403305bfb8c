"""Progress bar with the loss."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from .._progress import progress_bar
from ._history import History


@contextlib.contextmanager
def reported(iterations: int, *, shown: bool) -> Iterator[Callable[[History], None]]:
    """Yield a function that takes the history after each iteration; it draws a bar if wanted."""
    if not shown:
        yield lambda history: None
        return
    with progress_bar(iterations, unit="iterations") as update:
        yield lambda history: update(len(history), describe(history))


def describe(history: History) -> str:
    """Return the last iteration in a line."""
    if not len(history):
        return "compiling"
    parts = [f"loss {history.loss[-1]:.3e}", f"best {history.loss[history.best]:.3e}"]
    if history.held_out[-1] == history.held_out[-1]:
        parts.append(f"held out {history.held_out[-1]:.3e}")
    lost = int(history.dropped[-1] + history.held_out_dropped[-1])
    return ", ".join(parts + ([f"{lost} dropped"] if lost else []))
