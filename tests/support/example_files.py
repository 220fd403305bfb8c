"""Files of the package example-robot-data."""

from importlib.metadata import files
from pathlib import Path


def example_file(ending: str) -> Path:
    """Return the one file whose path ends so, such as ``panda_description/urdf/panda.urdf``."""
    (found,) = (file for file in files("example-robot-data") or () if str(file).endswith(f"/{ending}"))
    return Path(str(found.locate()))
