"""The category of this package's warnings, and how they are given."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

_PACKAGE = str(Path(__file__).parent)


class OsikWarning(UserWarning):
    """Something that was guessed, or is probably not meant; the message says how to state what is meant.

    ``warnings.simplefilter("error", osik_jax.OsikWarning)`` turns these warnings into exceptions.
    """


def warn(message: str) -> None:
    """Gives an ``OsikWarning`` that points at the line outside this package that led here."""
    level, frame = 2, sys._getframe(1)
    while frame is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, OsikWarning, stacklevel=level)
