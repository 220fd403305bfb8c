"""Thread priorities of a live view: the control loop runs before the drawing threads."""

from __future__ import annotations

import os
import sys
import threading

_CONTROL, _DRAWING = -10, 5
"""Niceness of the control and drawing threads; other threads have 0."""


def run_before_others() -> None:
    """Raise the priority of the calling thread, on Linux and with the permission (root)."""
    _be_nice(_CONTROL)


def run_after_others() -> None:
    """Lower the priority of the calling thread, on Linux, where niceness is per thread."""
    _be_nice(_DRAWING)


def _be_nice(niceness: int) -> None:
    if sys.platform == "linux":
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
        except PermissionError:
            return
