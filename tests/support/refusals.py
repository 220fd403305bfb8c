"""Calls that have to raise, and blocks that have to be silent."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest


def refuses(
    error: type[Exception] | tuple[type[Exception], ...], message: str, call: Callable, /, *given: Any, **options: Any
) -> None:
    """Assert that a call raises an error whose text matches a regular expression."""
    with pytest.raises(error, match=message):
        call(*given, **options)


@contextmanager
def no_warnings(kind: type[Warning] = Warning) -> Iterator[None]:
    """Make a warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", kind)
        yield
