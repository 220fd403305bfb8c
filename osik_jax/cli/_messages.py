"""Messages of the commands: errors in one line, and notes."""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

USER_ERRORS = (OSError, KeyError, ValueError, ImportError)


class CommandError(Exception):
    """Something that the user can set right; told in one line."""


def refuse(command: Any, wrong: bool, names: Sequence[str], place: str) -> None:
    """Raise CommandError if options of these names are given (other than their defaults) where they are ``wrong``.

    ``place``: what they go with.
    """
    defaults = {field.name: field.default for field in dataclasses.fields(command)}
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(command, name) != defaults[name]]
    if wrong and given:
        raise CommandError(f"{', '.join(given)} {'goes' if len(given) == 1 else 'go'} with {place}")


@contextmanager
def notes() -> Iterator[None]:
    """Tell this package's warnings in one line each, in the words of the command line."""
    from .._errors import OsikWarning

    told = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if not issubclass(category, OsikWarning):
            return told(message, category, *where, **options)
        print(f"osik: note: {_as_options(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", OsikWarning)
        warnings.showwarning = show
        yield


@contextmanager
def told() -> Iterator[None]:
    """Turn the exceptions of wrong input into a one-line message."""
    from .._errors import OsikError

    try:
        yield
    except (*USER_ERRORS, OsikError) as error:
        text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        raise CommandError(_as_options(" ".join(text.split()))) from error


def _as_options(text: str) -> str:
    """Return a message with arguments of Python as options of the command line."""
    return text.replace("floating_base=False", "--base fixed").replace("floating_base=True", "--base floating")


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Tell in one line that a file could not be written, as on a full disk."""
    try:
        yield
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error.strerror or error}; it may be incomplete") from error
