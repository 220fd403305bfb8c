"""Output folder of a demonstration, checked before the work starts."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from ._motion import Motion

_PICTURES = 12_000_000
"""Upper bound of the size of film, figure, picture and report [bytes]."""


def writable_folder(path: Path, motion: Motion, *, schemes: int, dt: float) -> Path:
    """Create the folder and check that the files can be written to it, the motion counted without compression.

    Raises:
        OSError: it cannot be made, nothing can be written to it, or too little room is left on its disk.
    """
    path.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(b"\0" * 4096)
            file.flush()
    except OSError as error:
        raise OSError(f"cannot write to {path}: {error.strerror or error}") from error
    entries = 1 + schemes * (motion.robot.nq + motion.robot.nv)
    free, needed = shutil.disk_usage(path).free, _PICTURES + 8 * (round(motion.duration / dt) + 1) * entries
    if free < needed:
        raise OSError(f"{path} has {free / 1e6:.1f} MB of room left, and up to {needed / 1e6:.0f} MB are needed")
    return path
