"""Waiting for what another thread or a browser does."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def until(holds: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Waits until something holds; whether it did in time."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


@contextmanager
def steps_of(loop: Any) -> Iterator[list[Any]]:
    """A list that gets the snapshot after every step of a control loop."""
    steps, step = [], loop._step

    def watched(own: Any) -> None:
        step(own)
        steps.append(loop.snapshot)

    loop._step = watched
    try:
        yield steps
    finally:
        del loop._step
