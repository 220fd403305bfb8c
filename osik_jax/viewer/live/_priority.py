"""Thread priorities of a live view: the control loop runs before the drawing threads."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

CONTROL, DRAWING = -10, 5
"""Niceness of the control and drawing threads; other threads have 0."""


def be_nice(niceness: int) -> None:
    """Set the niceness of the calling thread on Linux, where threads have their own; below 0 needs root."""
    if sys.platform == "linux":
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
