"""Robots that come with the package: MJCF files under ``osik_jax/robots``."""

from __future__ import annotations

from importlib import resources
from typing import Any

from .._tree import unknown_name
from ._mjcf import from_mjcf

ROBOTS = ("nao", "arm7")


def embedded(name: str) -> dict[str, Any]:
    """The fields of an embedded robot.

    Args:
        name: ``"nao"`` or ``"arm7"``.

    Raises:
        KeyError: no such robot; the message lists those that exist.
    """
    if name not in ROBOTS:
        raise unknown_name("robot", name, ROBOTS)
    return from_mjcf((resources.files("osik_jax") / "robots" / f"{name}.xml").read_text(encoding="utf-8"))
