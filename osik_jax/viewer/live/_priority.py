"""Thread priorities of a live view: the control loop runs before the drawing threads."""

from __future__ import annotations

import os
import sys
import threading

_CONTROL, _DRAWING = -10, 5
"""Niceness; 0 is what other threads have."""


def run_before_others() -> None:
    """Prefers the thread that calls; only with the right to do so, as root has it, and on Linux."""
    _be_nice(_CONTROL)


def run_after_others() -> None:
    """Lets other threads go before the one that calls; on Linux, where niceness is a thread's own."""
    _be_nice(_DRAWING)


def _be_nice(niceness: int) -> None:
    if sys.platform == "linux":
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
        except PermissionError:
            return
