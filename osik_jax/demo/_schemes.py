"""Schemes of the demonstration by their names on the command line."""

from __future__ import annotations

from typing import Any

from .._errors import unknown_name
from ..schemes import HierarchicalQP, NullSpace, WeightedQP

SCHEMES = ("weighted", "null-space", "hierarchical")
TITLES = {"weighted": "Weighted QP", "null-space": "Null space", "hierarchical": "Hierarchical QP"}
PROMISES_LIMITS = ("weighted", "hierarchical")
"""Schemes whose velocities satisfy the limits by construction."""


def make_scheme(name: str) -> Any:
    """Return a scheme with its default settings.

    Raises:
        KeyError: no such scheme; the message lists those that exist.
    """
    if name not in SCHEMES:
        raise unknown_name("scheme", name, SCHEMES)
    return {"weighted": WeightedQP, "null-space": NullSpace, "hierarchical": HierarchicalQP}[name]()
