"""Calls that have to raise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


def refuses(
    error: type[Exception] | tuple[type[Exception], ...], message: str, call: Callable, /, *given: Any, **options: Any
) -> None:
    """Assert that a call raises an error whose text matches a regular expression."""
    with pytest.raises(error, match=message):
        call(*given, **options)
