"""The base of this package's exceptions, the category of its warnings, and how those are given."""

from __future__ import annotations

import difflib
import re
import sys
import warnings
from pathlib import Path

_PACKAGE = str(Path(__file__).parent)
_WRAPPERS = ("equinox", "jaxtyping")
"""Packages that call methods of ours for a caller: a warning points beyond them too."""


class OsikError(Exception):
    """Base of what this package raises for wrong input, beside Python's own type of it.

    What is raised is a KeyError, TypeError or ValueError too, as the docstrings say: catch either.
    """


class OsikKeyError(OsikError, KeyError):
    """A name that does not exist; its text prints as it is, without the quotes of a KeyError."""

    def __str__(self) -> str:
        return Exception.__str__(self)


class OsikTypeError(OsikError, TypeError):
    """An object of the wrong type."""


class OsikValueError(OsikError, ValueError):
    """A value that cannot be."""


class OsikWarning(UserWarning):
    """Something that was guessed, or is probably not meant; the message says how to state what is meant.

    ``warnings.simplefilter("error", osik_jax.OsikWarning)`` turns these warnings into exceptions.
    """


def warn(message: str) -> None:
    """Give an ``OsikWarning`` that points at the line outside this package that led here."""
    loaded = [sys.modules[name] for name in _WRAPPERS if name in sys.modules]
    wrappers = [str(Path(module.__file__).parent) for module in loaded if module.__file__]
    inside, level, frame = (_PACKAGE, *wrappers), 2, sys._getframe(1)
    while frame is not None and frame.f_code.co_filename.startswith(inside):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, OsikWarning, stacklevel=level)


def unknown_name(kind: str, name: object, available: tuple[str, ...]) -> KeyError:
    """Return the exception for a name that does not exist: the nearest one that does, and all of them."""
    close = difflib.get_close_matches(str(name), available, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    noun = re.split(" of | with ", kind)[0]
    kinds = (f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s") + kind[len(noun) :]
    return OsikKeyError(f"no {kind} {name!r}{hint} {kinds}: {', '.join(available) or '(none)'}")


def missing_extra(what: str, needs: str, extra: str) -> ModuleNotFoundError:
    """The exception for a package that an extra of this one installs."""
    return ModuleNotFoundError(f'{what} needs {needs}: pip install ".[{extra}]" in the folder of osik-jax')
