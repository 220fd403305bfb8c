"""Robots that tests have as files of MuJoCo, in tests/data/mjcf."""

from pathlib import Path

MJCF = Path(__file__).parents[1] / "data" / "mjcf"


def mjcf(name: str) -> str:
    """Return the text of a file."""
    return (MJCF / f"{name}.xml").read_text(encoding="utf-8")
